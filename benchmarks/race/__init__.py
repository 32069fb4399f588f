"""Time to a tip error, against the peers."""
