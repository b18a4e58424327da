"""What all importers share: options, limits, the sketch that they fill in, and the plan that becomes of it."""
