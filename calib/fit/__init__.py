"""Fits: springs, chambers, actuators, damping and the sim-to-real network."""
