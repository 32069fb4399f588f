"""Demonstrations: recorded by a scripted expert or by hand."""
