// Makes a Program from Python's arguments: ArrayProgram.arguments in array_program.py.

#pragma once

#include "extension.h"

#include "program.h"

namespace batchpid {

template <class T>
std::vector<T> values_of(char const *bytes, Py_ssize_t size) {
  std::vector<T> all(static_cast<std::size_t>(size) / sizeof(T));
  std::memcpy(all.data(), bytes, all.size() * sizeof(T));
  return all;
}

inline std::nullptr_t misfit() {
  PyErr_SetString(PyExc_ValueError, "arrays do not fit the program");
  return nullptr;
}

// Add a copy of a constant: one number, one row, or all rows.
template <class T>
bool add_constant(Program &program, Py_buffer const &view) {
  Index const columns = program.columns, size = view.len / static_cast<Index>(sizeof(T));
  if (view.itemsize != sizeof(T) || (size != 1 && size != columns && size != program.rows * columns)) return false;
  bool const is_full = size != 1 && size != columns;
  std::vector<T> all(static_cast<std::size_t>(is_full ? size : program.chunk));
  T const *from = static_cast<T const *>(view.buf);
  for (std::size_t i = 0; i < all.size(); ++i) all[i] = from[static_cast<Index>(i) % size];
  std::vector<double> memory((all.size() * sizeof(T) + sizeof(double) - 1) / sizeof(double));
  std::memcpy(memory.data(), all.data(), all.size() * sizeof(T));
  program.shapes.push_back(is_full ? Shape::FULL : Shape::ROW);
  program.constants.push_back(std::move(memory));
  return true;
}

// Read the segments whose code has a pass in a table.
inline bool read_segments(Program &program, PyObject *segments, Fused const *table, std::size_t size) {
  for (Py_ssize_t i = 0, count = PyTuple_Size(segments); i < count; ++i) {
    Segment segment{};
    char const *code, *operands, *results;
    Py_ssize_t code_size, operands_size, results_size;
    if (!PyArg_ParseTuple(PyTuple_GetItem(segments, i), "nny#y#y#", &segment.first, &segment.count, &code, &code_size,
                          &operands, &operands_size, &results, &results_size)) {
      return false;
    }
    auto const wanted = values_of<std::int32_t>(code, code_size);
    auto const *fused = std::find_if(table, table + size, [&](Fused const &each) {
      return std::equal(wanted.begin(), wanted.end(), each.code, each.code + each.size);
    });
    if (fused == table + size) continue;
    segment.operands = values_of<std::int32_t>(operands, operands_size);
    segment.results = values_of<std::int32_t>(results, results_size);
    segment.single = fused->single;
    segment.pass = fused->pass;
    program.segments.push_back(std::move(segment));
  }
  return true;
}

// Arguments: operations, results (bytes of int32), segments, registers, inputs, constants (a tuple of contiguous arrays), rows,
// columns, single. Return null with a Python exception if they do not fit.
inline std::unique_ptr<Program> make_program(PyObject *arguments, Fused const *table = nullptr,
                                             std::size_t size = 0) {
  char const *operations, *results;
  Py_ssize_t operations_size, results_size;
  PyObject *constants, *segments;
  int single;
  auto program = std::make_unique<Program>();
  if (!PyArg_ParseTuple(arguments, "y#y#O!nnO!nnp", &operations, &operations_size, &results, &results_size,
                        &PyTuple_Type, &segments, &program->registers, &program->inputs, &PyTuple_Type, &constants, &program->rows,
                        &program->columns, &single)) {
    return nullptr;
  }
  program->operations = values_of<Operation>(operations, operations_size);
  program->results = values_of<std::int32_t>(results, results_size);
  program->single = single != 0;
  if (!read_segments(*program, segments, table, size)) return nullptr;
  if (program->rows < 1 || program->columns < 1) return misfit();
  // A multiple of 8 numbers (whole SIMD vectors), unless the rows are long.
  program->chunk = program->columns;
  while (program->chunk < CHUNK || (program->chunk < 4 * CHUNK && program->chunk % 8)) program->chunk += program->columns;
  Py_ssize_t const count = PyTuple_Size(constants);
  for (Py_ssize_t i = 0; i < count; ++i) {
    Py_buffer view;
    if (PyObject_GetBuffer(PyTuple_GetItem(constants, i), &view, PyBUF_C_CONTIGUOUS) != 0) return nullptr;
    bool const added = single ? add_constant<float>(*program, view) : add_constant<double>(*program, view);
    PyBuffer_Release(&view);
    if (!added) return misfit();
  }
  Index const given = count + program->inputs;
  auto const made_by = [&](std::int32_t number) {
    Index found = -1;
    for (std::size_t i = 0; i < program->operations.size(); ++i) {
      if (program->operations[i].out == number) found = found == -1 ? static_cast<Index>(i) : -2;
    }
    return found;
  };
  // A segment writes its results after it has read all its operands.
  auto const written = [&](Index operation) {
    for (Segment const &each : program->segments) {
      if (operation >= each.first && operation < each.first + each.count) return each.first + each.count - 1;
    }
    return operation;
  };
  for (std::size_t i = 0; i < program->results.size(); ++i) {
    auto const begin = program->results.begin(), self = begin + static_cast<Index>(i);
    program->made.push_back(std::find(begin, self, *self) == self ? written(made_by(*self)) : -1);
  }
  auto const all = static_cast<Index>(program->operations.size());
  for (Index number = count; number < given; ++number) {
    Index last = std::count(program->results.begin(), program->results.end(), number) ? all : -1;
    for (Index i = 0; i < all; ++i) {
      auto const &[code, out, operands] = program->operations[static_cast<std::size_t>(i)];
      if (!std::count(operands, operands + 3, number)) continue;
      // The others read after the first write.
      bool const is_elementwise = code != ROW_MINIMUM && code != MATRIX_VECTOR && code != GATHER;
      last = std::max(last, is_elementwise ? i : i + 1);
    }
    program->last_use.push_back(last);
  }
  return program;
}

// Return whether operations find tables where they take them, of a size that fits, and nowhere else.
inline bool tables_fit(Program const &program, std::vector<Input> const &inputs) {
  auto const constants = static_cast<Index>(program.constants.size());
  auto const size_of = [&](Index number) {  // 0: no table
    Index const i = number - constants;
    if (i < 0 || i >= program.inputs || inputs[static_cast<std::size_t>(i)].shape != Shape::TABLE) return Index{0};
    return inputs[static_cast<std::size_t>(i)].size;
  };
  for (auto const &[code, out, operands] : program.operations) {
    Index const size = size_of(operands[0]), columns = program.columns;
    bool const is_alone = operands[2] == operands[0];  // operands that are not there are copies of the first
    bool const reads_table = code == MATRIX_VECTOR || code == PUSH || code == TAKE_ROW;
    if ((size > 0) != reads_table) return false;
    if (size_of(operands[1]) || (!is_alone && size_of(operands[2]))) return false;
    if (code == MATRIX_VECTOR && size != columns * columns) return false;
    if ((code == TAKE_ROW || code == PUSH) && size % columns != 0) return false;
    if (code != GATHER) continue;
    if (program.single || operands[1] >= constants) return false;
    for (double const place : program.constants[static_cast<std::size_t>(operands[1])]) {
      if (!(place >= 0 && place < static_cast<double>(columns))) return false;
    }
  }
  return std::none_of(program.results.begin(), program.results.end(), size_of);
}

}  // namespace batchpid
