"""The arm in a browser: live and steered by hand, replayed from logs, shared as one file."""
