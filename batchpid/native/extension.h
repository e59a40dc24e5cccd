// Module of an extension, with digests of its files; see extensions.py.

#pragma once

#define PY_SSIZE_T_CLEAN
#ifndef Py_LIMITED_API
#define Py_LIMITED_API 0x030B0000
#endif
#include <Python.h>

#ifndef BATCHPID_SOURCES
#error "the digests of the files are missing: build with setup.py"
#endif

#pragma GCC visibility push(hidden)

namespace batchpid {

inline PyObject *make_module(PyModuleDef &definition) {
  PyObject *module = PyModule_Create(&definition);
  if (module == nullptr) return nullptr;
  if (PyModule_AddStringConstant(module, "sources", BATCHPID_SOURCES) != 0) {
    Py_DECREF(module);
    return nullptr;
  }
  return module;
}

}  // namespace batchpid

#pragma GCC visibility pop
