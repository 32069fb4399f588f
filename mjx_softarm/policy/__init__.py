"""A trained policy as one file, and its evaluation in NumPy."""
