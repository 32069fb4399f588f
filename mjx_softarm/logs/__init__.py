"""Logs of an arm: their columns, their files, and what can be wrong with them."""
