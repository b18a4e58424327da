"""Data sets that are drawn, not read: generated homes, and the same asked with photographs of others."""
