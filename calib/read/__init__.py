"""Reading of logs: checks, and reduction to rows that can be believed."""
