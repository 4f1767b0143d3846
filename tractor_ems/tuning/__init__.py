"""Scoring policies on many cycles in seconds, for tuning and for choosing between them."""
