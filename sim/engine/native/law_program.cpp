// Programs of operations on arrays (rows, columns) of double, such as the control law of a group of envs: traced in
// Python (sim/engine/array_program.py), run here in one call. Every operation is rounded as NumPy's.

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <memory>
#include <vector>

#include "extension.h"

namespace {

// OPERATIONS in interface.py.
enum Code : std::int32_t {
  ADD, SUBTRACT, MULTIPLY, DIVIDE, MAXIMUM, MINIMUM, GREATER, LESS, NOT_EQUAL, AND,
  NEGATIVE, ABSOLUTE, RINT, FINITE, WHERE, ROW_MINIMUM, MATRIX_VECTOR,
};

struct Operation {
  std::int32_t code, out, operands[3];  // numbers of registers
};

// Buffers of a tuple of arrays, released at the end of the scope.
class Buffers {
 public:
  bool open(PyObject *tuple, int flags) {
    Py_ssize_t const count = PyTuple_Size(tuple);
    for (Py_ssize_t i = 0; i < count; ++i) {
      views.emplace_back();
      PyObject *item = PyTuple_GetItem(tuple, i);
      if (item == nullptr || PyObject_GetBuffer(item, &views.back(), flags | PyBUF_C_CONTIGUOUS) != 0) {
        views.pop_back();
        return false;
      }
    }
    return count >= 0;
  }
  ~Buffers() {
    for (Py_buffer &view : views) PyBuffer_Release(&view);
  }

  std::vector<Py_buffer> views;
};

struct Program {
  std::vector<Operation> operations;
  std::vector<std::int32_t> results;  // register of each output
  std::ptrdiff_t rows, columns, constants, inputs, registers;
  std::vector<double> memory;  // of all registers
};

constexpr char PROGRAM[] = "batchpid.law_program";

// Sum of n numbers as NumPy's for n <= 128: in order below eight, else eight sums side by side.
double pairwise_sum(double const *a, double const *b, std::ptrdiff_t n) {
  double sum = -0.0;
  std::ptrdiff_t i = 0;
  if (n >= 8) {
    double s[8];
    for (; i < 8; ++i) s[i] = a[i] * b[i];
    for (; i + 8 <= n; i += 8) {
      for (std::ptrdiff_t k = 0; k < 8; ++k) s[k] += a[i + k] * b[i + k];
    }
    sum = ((s[0] + s[1]) + (s[2] + s[3])) + ((s[4] + s[5]) + (s[6] + s[7]));
  }
  for (; i < n; ++i) sum += a[i] * b[i];
  return sum;
}

void apply(Program const &program, Code code, double *__restrict o, double const *a, double const *b, double const *c) {
  std::ptrdiff_t const columns = program.columns, n = program.rows * columns;
#define EACH(expression)                                           \
  for (std::ptrdiff_t i = 0; i < n; ++i) o[i] = (expression); \
  break
  switch (code) {
    case ADD: EACH(a[i] + b[i]);
    case SUBTRACT: EACH(a[i] - b[i]);
    case MULTIPLY: EACH(a[i] * b[i]);
    case DIVIDE: EACH(a[i] / b[i]);
    case MAXIMUM: EACH(a[i] > b[i] || a[i] != a[i] ? a[i] : b[i]);
    case MINIMUM: EACH(a[i] < b[i] || a[i] != a[i] ? a[i] : b[i]);
    case GREATER: EACH(a[i] > b[i] ? 1.0 : 0.0);
    case LESS: EACH(a[i] < b[i] ? 1.0 : 0.0);
    case NOT_EQUAL: EACH(a[i] != b[i] ? 1.0 : 0.0);
    case AND: EACH(a[i] * b[i]);
    case NEGATIVE: EACH(-a[i]);
    case ABSOLUTE: EACH(std::fabs(a[i]));
    case RINT: EACH(std::nearbyint(a[i]));
    case FINITE: EACH(a[i] - a[i] == 0.0 ? 1.0 : 0.0);
    case WHERE: EACH(a[i] != 0.0 ? b[i] : c[i]);
    case ROW_MINIMUM:
      for (std::ptrdiff_t row = 0; row < n; row += columns) {
        double least = a[row];
        for (std::ptrdiff_t i = row + 1; i < row + columns; ++i) least = least < a[i] || least != least ? least : a[i];
        std::fill_n(o + row, columns, least);
      }
      break;
    case MATRIX_VECTOR:  // a (rows, columns, columns)
      for (std::ptrdiff_t i = 0; i < n; ++i) o[i] = pairwise_sum(a + i * columns, b + i / columns * columns, columns);
      break;
  }
#undef EACH
}

template <class T>
std::vector<T> values(char const *bytes, Py_ssize_t size) {
  std::vector<T> all(static_cast<std::size_t>(size) / sizeof(T));
  std::memcpy(all.data(), bytes, all.size() * sizeof(T));
  return all;
}

PyObject *misfit() {
  PyErr_SetString(PyExc_ValueError, "arrays do not fit the program");
  return nullptr;
}

// program(operations, results, registers, inputs, constants, rows, columns): operations and results are bytes of int32.
// The first registers hold the constants, arrays of (rows, columns), (1, columns) or one number; the next the inputs.
PyObject *make_program(PyObject *, PyObject *arguments) {
  char const *operations, *results;
  Py_ssize_t operations_size, results_size;
  PyObject *constants;
  auto program = std::make_unique<Program>();
  if (!PyArg_ParseTuple(arguments, "y#y#nnOnn", &operations, &operations_size, &results, &results_size,
                        &program->registers, &program->inputs, &constants, &program->rows, &program->columns)) {
    return nullptr;
  }
  program->operations = values<Operation>(operations, operations_size);
  program->results = values<std::int32_t>(results, results_size);
  Buffers given;
  if (!given.open(constants, PyBUF_SIMPLE)) return nullptr;
  program->constants = static_cast<std::ptrdiff_t>(given.views.size());
  std::ptrdiff_t const columns = program->columns, n = program->rows * columns;
  auto const known = [&](std::int32_t number) { return number >= 0 && number < program->registers; };
  bool fits = n > 0 && program->constants + program->inputs <= program->registers;
  for (Operation const &each : program->operations) {
    fits = fits && known(each.out) && each.out >= program->constants + program->inputs && each.code <= MATRIX_VECTOR &&
           each.code >= ADD && std::all_of(each.operands, each.operands + 3, known);
  }
  fits = fits && std::all_of(program->results.begin(), program->results.end(), known);
  if (!fits) return misfit();
  program->memory.resize(static_cast<std::size_t>(program->registers * n));
  for (std::ptrdiff_t i = 0; i < program->constants; ++i) {
    Py_buffer const &view = given.views[i];
    auto const size = static_cast<std::ptrdiff_t>(view.len / sizeof(double));
    if (view.itemsize != sizeof(double) || (size != n && size != columns && size != 1)) return misfit();
    double const *from = static_cast<double const *>(view.buf);
    double *to = program->memory.data() + i * n;
    for (std::ptrdiff_t at = 0; at < n; ++at) to[at] = from[size == n ? at : size == 1 ? 0 : at % columns];
  }
  return PyCapsule_New(program.release(), PROGRAM, [](PyObject *capsule) {
    delete static_cast<Program *>(PyCapsule_GetPointer(capsule, PROGRAM));
  });
}

// run(program, inputs, outputs): inputs are double, (rows, columns) or a matrix for each row; outputs double or bool.
PyObject *run(PyObject *, PyObject *arguments) {
  PyObject *capsule, *inputs, *outputs;
  if (!PyArg_ParseTuple(arguments, "OOO", &capsule, &inputs, &outputs)) return nullptr;
  auto *program = static_cast<Program *>(PyCapsule_GetPointer(capsule, PROGRAM));
  Buffers read, written;
  if (program == nullptr || !read.open(inputs, PyBUF_SIMPLE) || !written.open(outputs, PyBUF_WRITABLE)) return nullptr;
  std::ptrdiff_t const n = program->rows * program->columns, double_bytes = sizeof(double);
  std::vector<double const *> registers(static_cast<std::size_t>(program->registers));
  for (std::ptrdiff_t i = 0; i < program->registers; ++i) registers[i] = program->memory.data() + i * n;
  bool fits = static_cast<std::ptrdiff_t>(read.views.size()) == program->inputs &&
              written.views.size() == program->results.size();
  std::vector<char> is_matrix(registers.size());
  for (std::size_t i = 0; fits && i < read.views.size(); ++i) {
    Py_buffer const &view = read.views[i];
    auto const number = program->constants + static_cast<std::ptrdiff_t>(i);
    is_matrix[number] = view.len == n * program->columns * double_bytes;
    fits = view.itemsize == double_bytes && (view.len == n * double_bytes || is_matrix[number]);
    registers[number] = static_cast<double const *>(view.buf);
  }
  for (Py_buffer const &view : written.views) fits = fits && view.len == n * view.itemsize;
  for (Operation const &each : program->operations) {
    fits = fits && (each.code != MATRIX_VECTOR || is_matrix[each.operands[0]]);
  }
  if (!fits) return misfit();
  for (Operation const &each : program->operations) {
    double *out = program->memory.data() + each.out * n;
    auto const *operands = each.operands;
    apply(*program, static_cast<Code>(each.code), out, registers[operands[0]], registers[operands[1]],
          registers[operands[2]]);
  }
  for (std::size_t i = 0; i < written.views.size(); ++i) {
    Py_buffer const &view = written.views[i];
    double const *from = registers[program->results[i]];
    if (view.itemsize == 1) {
      for (std::ptrdiff_t at = 0; at < n; ++at) static_cast<char *>(view.buf)[at] = from[at] != 0.0;
    } else {
      std::memcpy(view.buf, from, static_cast<std::size_t>(n * double_bytes));
    }
  }
  Py_RETURN_NONE;
}

PyMethodDef METHODS[] = {
    {"program", make_program, METH_VARARGS, nullptr},
    {"run", run, METH_VARARGS, nullptr},
    {nullptr, nullptr, 0, nullptr},
};
PyModuleDef MODULE = {PyModuleDef_HEAD_INIT, "_law_program", nullptr, -1, METHODS, nullptr, nullptr, nullptr, nullptr};

}  // namespace

PyMODINIT_FUNC PyInit__law_program() { return batchpid::make_module(MODULE); }
