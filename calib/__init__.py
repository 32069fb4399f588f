"""Calibration of the soft arm from real logs. Run from the checkout, not part of the wheel."""
