"""Demonstrations of a scripted expert: planned, recorded on an arm, read and checked."""
