"""Array functions as native programs: tracer, table of operations, interpreter in C++, loading, and
the compiled law.

The interpreter is an optional extension, built with batchpid where there is a C++ compiler. Where
it was not built, and with the environment variable ``BATCHPID_NATIVE=0``, NumPy computes the same
bytes.
"""
