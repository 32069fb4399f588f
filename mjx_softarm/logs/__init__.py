"""Logs of an arm: their columns, their files, and the checks of their rows."""
