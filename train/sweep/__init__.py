"""Sweeps: several runs trained as one job."""
