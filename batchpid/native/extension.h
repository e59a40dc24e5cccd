// Module of an extension, with digests of its tables and sources; see extensions.py.

#pragma once

#include "batchpid/native/buffer.h"

#if !defined(BATCHPID_TABLES) || !defined(BATCHPID_SOURCES)
#error "the digests of the tables and of the sources are missing: build with setup.py"
#endif

namespace batchpid {

template <class Function>
PyCFunction method(Function function) {
  return reinterpret_cast<PyCFunction>(reinterpret_cast<void (*)()>(function));
}

inline PyObject *make_module(PyModuleDef &definition) {
  PyObject *module = PyModule_Create(&definition);
  if (module == nullptr) return nullptr;
  if (PyModule_AddStringConstant(module, "tables", BATCHPID_TABLES) != 0 ||
      PyModule_AddStringConstant(module, "sources", BATCHPID_SOURCES) != 0) {
    Py_DECREF(module);
    return nullptr;
  }
  return module;
}

}  // namespace batchpid
