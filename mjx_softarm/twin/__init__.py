"""Digital twins: simulated stand-ins for an arm that hide their parameters."""
