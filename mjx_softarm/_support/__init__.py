"""What several rooms need and no reader of one has to know: arrays, files, compilation."""
