"""A maker's own vehicle: are its parameters plausible, and what do recordings say about them."""
