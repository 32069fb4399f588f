"""Speed of settling and of environment steps."""
