"""A station as a web page: status and live view for people who install nothing (ADR 34)."""
