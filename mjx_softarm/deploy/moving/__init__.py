"""Goals that move: the way, its lead, the error behind it, and the strategies that follow it. NumPy only."""
