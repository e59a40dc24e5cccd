// Arrays of Python with a row for each robot, and rows of several robots at once.

#pragma once

#include <cstdint>

#include "batchpid/native/buffer.h"
#include "batchpid/native/lanes.h"

#pragma GCC visibility push(hidden)

namespace batchpid {

// Array (rows, columns), or (1, columns) for all rows; without data if it is left out.
struct Table {
  double *data = nullptr;
  std::int64_t columns = 0, rows = 0;

  explicit operator bool() const { return data != nullptr; }
  double *row(std::int64_t at) const { return data + (rows == 1 ? 0 : at) * columns; }
  // Copy columns of the rows from `first` on; the last row stands for those that there are not.
  void load(std::int64_t first, std::int64_t count, Lanes *out) const {
    double const *const end = data + (rows - 1) * columns, *from[WIDTH];
    for (int k = 0; k < WIDTH; ++k) from[k] = first + k < rows ? data + (first + k) * columns : end;
    for (std::int64_t c = 0; c < count; ++c) {
      for (int k = 0; k < WIDTH; ++k) out[c].of[k] = from[k][c];
    }
  }
  void load(std::int64_t first, Lanes *out) const { load(first, columns, out); }
  void store(std::int64_t first, std::int64_t count, Lanes const *values) const {
    if (data == nullptr) return;
    double *const to = data + first * columns;
    if (first + WIDTH <= rows) {
      for (std::int64_t c = 0; c < count; ++c) {
        for (int k = 0; k < WIDTH; ++k) to[k * columns + c] = values[c].of[k];
      }
    } else {
      for (std::int64_t c = 0; c < count; ++c) scatter(values[c], data, columns, c, first, rows);
    }
  }
  void store(std::int64_t first, Lanes const *values) const { store(first, columns, values); }
};

// Arrays of Python as tables of doubles; None is a table without data.
class Tables {
 public:
  // Open an input of 1 row or `rows`, or an output of `rows`.
  bool open(PyObject *object, std::int64_t columns, std::int64_t rows, bool output) {
    Table &table = tables_[count_];
    Buffer &buffer = buffers_[count_++];
    if (object == Py_None) return true;
    Py_ssize_t const given = PyObject_Size(object);
    if (given < 0) return false;
    std::int64_t const own = given == 1 && !output ? 1 : rows;
    int const flags = PyBUF_C_CONTIGUOUS | PyBUF_FORMAT | (output ? PyBUF_WRITABLE : 0);
    if (!buffer.open(object, own * columns, sizeof(double), flags)) return false;
    if (!buffer.is_double()) {
      PyErr_SetString(PyExc_ValueError, "an array is not float64");
      return false;
    }
    table = Table{buffer.as<double>(), columns, own};
    return true;
  }
  Table const &operator[](int at) const { return tables_[at]; }

 private:
  static constexpr int MOST = 52;

  Buffer buffers_[MOST];
  Table tables_[MOST];
  int count_ = 0;
};

}  // namespace batchpid

#pragma GCC visibility pop
