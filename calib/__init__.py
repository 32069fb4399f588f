"""Calibration of the soft arm from real logs."""
