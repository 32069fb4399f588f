"""Fits to the arm in motion: its actuators, then its damping."""
