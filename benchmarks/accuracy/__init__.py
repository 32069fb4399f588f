"""Accuracy of trained policies."""
