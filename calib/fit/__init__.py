"""Fits: springs, chambers, damping and the sim-to-real network."""
