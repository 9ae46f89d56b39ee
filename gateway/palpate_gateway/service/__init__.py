"""The gateway's process: sensors in threads, from reading to bus."""
