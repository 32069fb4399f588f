"""Tools that several packages share: arrays, sealed files, compilation, command lines."""
