"""The optimum of a known cycle: dynamic programming, its certificate, and the score against it."""
