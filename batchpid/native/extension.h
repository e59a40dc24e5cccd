// Module of an extension, with digests of its files; see extensions.py.

#pragma once

#include "batchpid/native/buffer.h"

#ifndef BATCHPID_SOURCES
#error "the digests of the files are missing: build with setup.py"
#endif

namespace batchpid {

template <class Function>
PyCFunction method(Function function) {
  return reinterpret_cast<PyCFunction>(reinterpret_cast<void (*)()>(function));
}

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
