"""Plan, run and resume fits, and describe them in records."""
