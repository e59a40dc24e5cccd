"""Arrays of NumPy and JAX alike: elementwise operations, leaves of named tuples, digests, representations."""
