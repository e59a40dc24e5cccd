// Python in the extensions: contiguous arrays, capsules, and modules with digests of their files (extensions.py).

#pragma once

#define PY_SSIZE_T_CLEAN
#ifndef Py_LIMITED_API
#define Py_LIMITED_API 0x030B0000
#endif
#include <Python.h>

#include <cstddef>
#include <memory>
#include <vector>

#ifndef BATCHPID_SOURCES
#error "the digests of the files are missing: build with setup.py"
#endif

namespace batchpid {

// Function on arrays that Python owns, for the programs of another extension.
struct Call {
  void (*run)(Call const &call);
};

// Contiguous buffer of a Python object, released at the end of the scope.
class Buffer {
 public:
  bool open(PyObject *object, Py_ssize_t count, Py_ssize_t size, int flags) {
    if (PyObject_GetBuffer(object, &view_, flags) != 0) return false;
    held_ = true;
    if ((size == 0 || view_.itemsize == size) && view_.len == count * view_.itemsize) return true;
    PyErr_SetString(PyExc_ValueError, "an array has a wrong size or type");
    return false;
  }
  ~Buffer() {
    if (held_) PyBuffer_Release(&view_);
  }
  template <class T>
  T *as() const {
    return static_cast<T *>(view_.buf);
  }
  // Whether the numbers are doubles, for a buffer opened with PyBUF_FORMAT.
  bool is_double() const { return view_.format != nullptr && view_.format[0] == 'd' && view_.format[1] == '\0'; }
  Py_ssize_t itemsize() const { return view_.itemsize; }

 private:
  Py_buffer view_{};
  bool held_ = false;
};

// Copy the numbers of an array.
template <class T>
bool copy(PyObject *array, Py_ssize_t count, std::vector<T> &to) {
  Buffer from;
  if (!from.open(array, count, sizeof(T), PyBUF_C_CONTIGUOUS)) return false;
  to.assign(from.as<T>(), from.as<T>() + count);
  return true;
}

// Return the object in a capsule, or null with an exception. T::CAPSULE is the name of its capsules.
template <class T>
T *held(PyObject *capsule) {
  return static_cast<T *>(PyCapsule_GetPointer(capsule, T::CAPSULE));
}

// Return a capsule that owns an object.
template <class T>
PyObject *capsule_of(std::unique_ptr<T> object) {
  return PyCapsule_New(object.release(), T::CAPSULE, [](PyObject *capsule) { delete held<T>(capsule); });
}

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
