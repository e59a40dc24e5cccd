// Arrays of Python with a row for each robot, and rows of several robots at once.

#pragma once

#include <utility>

#include "batchpid/native/extension.h"
#include "batchpid/native/lanes.h"

namespace batchpid {

// WIDTH numbers anywhere in an array.
typedef double Unaligned __attribute__((vector_size(WIDTH * sizeof(double)), aligned(sizeof(double)), may_alias));

// Transpose WIDTH vectors.
inline void transpose(Lanes *v) {
#if defined(__clang__) || __GNUC__ >= 12  // the first GCC with __builtin_shufflevector
  Lanes::Packed const a = v[0].of, b = v[1].of, c = v[2].of, d = v[3].of;
  auto const ab = __builtin_shufflevector(a, b, 0, 4, 2, 6), cd = __builtin_shufflevector(c, d, 0, 4, 2, 6);
  auto const ab_odd = __builtin_shufflevector(a, b, 1, 5, 3, 7), cd_odd = __builtin_shufflevector(c, d, 1, 5, 3, 7);
  v[0].of = __builtin_shufflevector(ab, cd, 0, 1, 4, 5);
  v[1].of = __builtin_shufflevector(ab_odd, cd_odd, 0, 1, 4, 5);
  v[2].of = __builtin_shufflevector(ab, cd, 2, 3, 6, 7);
  v[3].of = __builtin_shufflevector(ab_odd, cd_odd, 2, 3, 6, 7);
#else
  for (int i = 0; i < WIDTH; ++i) {
    for (int j = 0; j < i; ++j) std::swap(v[i].of[j], v[j].of[i]);
  }
#endif
}

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
    std::int64_t c = 0;
    for (; c + WIDTH <= count; c += WIDTH) {
      for (int k = 0; k < WIDTH; ++k) out[c + k].of = *reinterpret_cast<Unaligned const *>(from[k] + c);
      transpose(out + c);
    }
    for (; c < count; ++c) {
      for (int k = 0; k < WIDTH; ++k) out[c].of[k] = from[k][c];
    }
  }
  void load(std::int64_t first, Lanes *out) const { load(first, columns, out); }
  void store(std::int64_t first, std::int64_t count, Lanes const *values) const {
    if (data == nullptr) return;
    double *const to = data + first * columns;
    std::int64_t c = 0;
    for (; c + WIDTH <= count && first + WIDTH <= rows; c += WIDTH) {
      Lanes block[WIDTH] = {values[c], values[c + 1], values[c + 2], values[c + 3]};
      transpose(block);
      for (int k = 0; k < WIDTH; ++k) *reinterpret_cast<Unaligned *>(to + k * columns + c) = block[k].of;
    }
    for (; c < count; ++c) scatter(values[c], data, columns, c, first, rows);
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
  // Open arrays with these columns, of which those from `results` on are outputs.
  template <std::size_t N>
  bool open_all(PyObject *const *arrays, std::int64_t const (&columns)[N], std::int64_t rows, std::size_t results) {
    for (std::size_t i = 0; i < N; ++i) {
      if (!open(arrays[i], columns[i], rows, i >= results)) return false;
    }
    return true;
  }
  Table const &operator[](int at) const { return tables_[at]; }

 private:
  static constexpr int MOST = 56;

  Buffer buffers_[MOST];
  Table tables_[MOST];
  int count_ = 0;
};

}  // namespace batchpid
