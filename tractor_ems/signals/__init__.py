"""Any vehicle's topics as the stack's signals: maps in YAML, what a bag offers, what is covered."""
