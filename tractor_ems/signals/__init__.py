"""Any vehicle's topics as the stack's signals: maps in YAML, what a bag offers and covers."""
