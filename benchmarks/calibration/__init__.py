"""Accuracy of calibrations, and of payloads that are told with them."""
