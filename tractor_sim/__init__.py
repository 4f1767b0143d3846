"""The plant: engine, generator, battery and duty cycles of a series hybrid, and its node."""
