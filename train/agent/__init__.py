"""Agents: networks, losses and updates."""
