"""Plans in the formats of other tools: what the importers read back."""
