"""Logs read, checked and reduced to rows that can be believed."""
