"""A station as a service of its host: units of systemd, container files, and their removal."""
