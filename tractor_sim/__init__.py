"""The plant: engine, generator, battery and duty cycles of a series hybrid tractor, and its node."""
