"""Physics engines: the interface that the loop uses, and its implementations, one folder each."""
