// Objects of Python in C++: contiguous arrays, and capsules.

#pragma once

#define PY_SSIZE_T_CLEAN
#ifndef Py_LIMITED_API
#define Py_LIMITED_API 0x030B0000
#endif
#include <Python.h>

#include <cstddef>
#include <memory>
#include <vector>

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

// Open arrays of double with these counts of numbers, of which those from `written` on are results. None is an array of
// no numbers, without data.
template <std::size_t N>
bool open_doubles(PyObject *const *given, Py_ssize_t const (&counts)[N], std::size_t written, Buffer (&arrays)[N]) {
  for (std::size_t i = 0; i < N; ++i) {
    int const flags = PyBUF_C_CONTIGUOUS | (i < written ? 0 : PyBUF_WRITABLE);
    if (counts[i] == 0 && given[i] == Py_None) continue;
    if (!arrays[i].open(given[i], counts[i], sizeof(double), flags)) return false;
  }
  return true;
}

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

}  // namespace batchpid
