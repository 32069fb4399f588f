"""Accuracy of calibration and of trained policies."""
