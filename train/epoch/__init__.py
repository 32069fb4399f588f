"""One epoch of training: replay, hindsight and the jitted loop."""
