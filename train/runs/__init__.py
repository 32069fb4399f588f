"""Runs: folders, checkpoints, evaluation, pictures and export."""
