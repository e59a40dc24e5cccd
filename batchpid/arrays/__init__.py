"""Operations on NumPy and JAX arrays: elementwise operations, leaves of named tuples, digests,
representations.
"""
