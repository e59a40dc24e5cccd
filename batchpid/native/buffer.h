// Contiguous arrays of Python.

#pragma once

#define PY_SSIZE_T_CLEAN
#ifndef Py_LIMITED_API
#define Py_LIMITED_API 0x030B0000
#endif
#include <Python.h>

#pragma GCC visibility push(hidden)

namespace batchpid {

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

}  // namespace batchpid

#pragma GCC visibility pop
