"""Array functions as native programs: tracer, table of operations, interpreter in C++, loading,
the compiled law, and kinematics and control of tools (task_space.cpp).

Both extensions are optional, built with batchpid where there is a C++ compiler. Where they were not
built, and with the environment variable ``BATCHPID_NATIVE=0``, NumPy computes the same: programs to
the bit, task space but for the last bits.
"""
