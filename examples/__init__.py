"""The demo: an example flat, photographs taken in it, and a client of the service."""
