"""Every table of the paper, run again: `lalaloc reproduce`."""
