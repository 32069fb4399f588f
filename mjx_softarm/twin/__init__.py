"""Digital twins: simulated arms with hidden parameters, in place of a real arm."""
