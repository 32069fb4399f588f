"""Tools that several rooms share and no reader of one has to know: arrays, files, compilation."""
