// Programs of operations on arrays (program.h) as a module of Python.

#include "make_program.h"
#include "passes.h"

#include <atomic>
#include <system_error>
#include <thread>

using namespace batchpid;

namespace {

constexpr Index WITH_LOCK = 1 << 14;  // most numbers computed with the GIL held: a few microseconds

// First fields of a dtype and of an array of NumPy: _PyArray_DescrNumPy2 and PyArrayObject_fields in
// numpy/ndarraytypes.h. All extensions compiled for NumPy 2 rely on their layouts. A Python buffer would cost 0.2 us
// per array, more than the law of a few envs.
struct Dtype {
  PyObject head;
  PyTypeObject *type;
  char kind, letter, byteorder, flags;
  int number;
};
struct Array {
  PyObject head;
  char *data;
  int dimensions;
  Py_ssize_t *shape, *strides;
  PyObject *base;
  Dtype const *dtype;
  int flags;
};
constexpr int CONTIGUOUS = 0x1, ALIGNED = 0x100, WRITEABLE = 0x400;
constexpr int BOOL = 0, FLOAT = 11, DOUBLE = 12;  // numbers of dtypes

PyTypeObject *array_type;
PyObject *make_empty;

// use(ndarray, empty): a type and a function of NumPy, kept until the process ends.
PyObject *use(PyObject *, PyObject *arguments) {
  PyObject *type;
  if (!PyArg_ParseTuple(arguments, "OO", &type, &make_empty)) return nullptr;
  array_type = reinterpret_cast<PyTypeObject *>(type);
  Py_INCREF(arguments);  // for good
  Py_RETURN_NONE;
}

// Return the array in an object; null unless its class is ndarray itself and it is contiguous, aligned, of this dtype.
Array const *array_of(PyObject *object, int dtype) {
  if (Py_TYPE(object) != array_type) return nullptr;
  auto const *array = reinterpret_cast<Array const *>(object);
  constexpr int needed = CONTIGUOUS | ALIGNED;
  bool const is_native = array->dtype->byteorder == '=' || array->dtype->byteorder == '|';
  return array->dtype->number == dtype && is_native && (array->flags & needed) == needed ? array : nullptr;
}

// look(array): address, shape, number of the dtype, and whether it is writeable, as read by this module; None for an
// array that is not contiguous or not (rows, columns).
PyObject *look(PyObject *, PyObject *object) {
  int const dtype = Py_TYPE(object) == array_type ? reinterpret_cast<Array const *>(object)->dtype->number : BOOL;
  auto const *array = array_of(object, dtype);
  if (array == nullptr || array->dimensions != 2) Py_RETURN_NONE;
  return Py_BuildValue("Nnnii", PyLong_FromVoidPtr(array->data), array->shape[0], array->shape[1], dtype,
                       (array->flags & WRITEABLE) != 0);
}

int dtype_of(Program const &program) { return program.single ? FLOAT : DOUBLE; }

bool read_input(Program const &program, Index rows, PyObject *object, Input &input) {
  auto const *array = array_of(object, dtype_of(program));
  if (array == nullptr) return false;
  Index const columns = program.columns, dimensions = array->dimensions;
  auto const *shape = array->shape;
  input = {array->data, Shape::FULL, 0, (array->flags & WRITEABLE) != 0};
  if (dimensions == 2 && shape[0] == rows && shape[1] == columns) return true;
  if ((dimensions == 1 && shape[0] == columns) || (dimensions == 2 && shape[0] == 1 && shape[1] == columns)) {
    input.shape = Shape::ROW;
  } else if (dimensions == 2 && shape[0] == rows && shape[1] == 1) {
    input.shape = Shape::COLUMN;
  } else if (dimensions == 3 && shape[0] == rows) {
    input.shape = Shape::TABLE;
    input.size = shape[1] * shape[2];
  } else {
    input.shape = Shape::NUMBER;
    return dimensions == 0 || (dimensions <= 2 && shape[0] == 1 && shape[dimensions - 1] == 1);
  }
  return true;
}

bool read_output(Program const &program, Index rows, PyObject *object, Output &output) {
  auto const *mask = array_of(object, BOOL);
  auto const *array = mask ? mask : array_of(object, dtype_of(program));
  if (array == nullptr || !(array->flags & WRITEABLE) || array->dimensions != 2) return false;
  output = {array->data, mask != nullptr};
  return array->shape[0] == rows && array->shape[1] == program.columns;
}

// Bytes of an input.
Index size_of(Program const &program, Index rows, Input const &input) {
  Index const columns = program.columns, sizes[] = {1, columns, rows, rows * columns, rows * input.size};
  return sizes[static_cast<int>(input.shape)] * program.itemsize();
}

bool meet(void const *first, Index first_size, void const *second, Index second_size) {
  auto const *a = static_cast<char const *>(first), *b = static_cast<char const *>(second);
  return a < b + second_size && b < a + first_size;
}

// Return whether an output overlaps an input. An input of the output's shape at the same address is allowed.
bool overlaps(Program const &program, Index rows, Output const &output, Input const &input) {
  Index const written = rows * program.columns * (output.is_mask ? 1 : program.itemsize());
  if (!meet(input.data, size_of(program, rows, input), output.data, written)) return false;
  return input.data != output.data || input.shape != Shape::FULL || output.is_mask;
}

bool fits(Program const &program, Index rows, std::vector<Input> const &inputs, std::vector<Output> const &outputs) {
  bool good = static_cast<Index>(inputs.size()) == program.inputs && outputs.size() == program.results.size() &&
              (rows == program.rows || std::count(program.shapes.begin(), program.shapes.end(), Shape::FULL) == 0);
  if (!good || !tables_fit(program, inputs)) return false;
  for (Operation const &each : program.operations) {
    if (each.code != PUSH) continue;
    Input const &history = inputs[static_cast<std::size_t>(each.out) - program.constants.size()];
    good = good && history.is_writeable;
    for (Input const &input : inputs) {
      good = good && (&input == &history || !meet(history.data, size_of(program, rows, history), input.data,
                                                  size_of(program, rows, input)));
    }
  }
  for (Output const &output : outputs) {
    for (Output const &other : outputs) good = good && (&other == &output || other.data != output.data);
    for (Input const &input : inputs) good = good && !overlaps(program, rows, output, input);
  }
  return good;
}

BATCHPID_CLONES void run_single(Program const &program, Input const *inputs, Output const *outputs, Index first,
                                Index rows) {
  detail::run_rows<float>(program, inputs, outputs, first, rows);
}

// Run a program on all rows, on several threads. The result does not depend on their number. Up to WITH_LOCK numbers
// are computed with the GIL held.
void run_all(Program const &program, Input const *inputs, Output const *outputs, Index rows, int threads) {
  auto const run_some = program.single ? run_single : batchpid::run;
  if (rows * program.columns <= WITH_LOCK && threads == 1) return run_some(program, inputs, outputs, 0, rows);
  Py_BEGIN_ALLOW_THREADS
  // Rows that a thread takes at once: some blocks, and few enough to keep all threads busy to the end.
  Index const some = std::max<Index>(1, std::min(4 * BLOCK / program.columns, rows / (4 * threads)));
  Index const slab = threads == 1 ? rows : some;
  std::atomic<Index> next{0};
  auto const work = [&] {
    for (Index row; (row = next.fetch_add(slab)) < rows;) {
      run_some(program, inputs, outputs, row, std::min(slab, rows - row));
    }
  };
  std::vector<std::thread> others;
  others.reserve(static_cast<std::size_t>(threads));
  try {
    while (static_cast<int>(others.size()) + 1 < threads) others.emplace_back(work);
  } catch (std::system_error const &) {  // no more threads available: the running ones do all the work
  }
  work();
  for (std::thread &other : others) other.join();
  Py_END_ALLOW_THREADS
}

// program(...): see make_program.h.
PyObject *make(PyObject *, PyObject *arguments) {
  auto program = make_program(arguments, PASSES, std::size(PASSES));
  if (program == nullptr) return nullptr;
  return capsule_of(std::move(program));
}

// Read the arrays of a tuple with read_input or read_output.
template <class Array, class Read>
bool read_all(Program const &program, Index rows, PyObject *arrays, std::vector<Array> &found, Read read) {
  for (Py_ssize_t i = 0, count = PyTuple_Size(arrays); i < count; ++i) {
    found.emplace_back();
    if (!read(program, rows, PyTuple_GetItem(arrays, i), found.back())) return false;
  }
  return true;
}

// run(program, rows, inputs, outputs, threads): two tuples of arrays.
PyObject *run_arrays(PyObject *, PyObject *arguments) {
  PyObject *capsule, *read, *written;
  Py_ssize_t rows;
  int threads;
  if (!PyArg_ParseTuple(arguments, "OnO!O!i", &capsule, &rows, &PyTuple_Type, &read, &PyTuple_Type, &written, &threads)) {
    return nullptr;
  }
  auto const *program = held<Program>(capsule);
  if (program == nullptr) return nullptr;
  std::vector<Input> inputs;
  std::vector<Output> outputs;
  bool const good = read_all(*program, rows, read, inputs, read_input) &&
                    read_all(*program, rows, written, outputs, read_output);
  if (!good || !fits(*program, rows, inputs, outputs)) return misfit();
  run_all(*program, inputs.data(), outputs.data(), rows, threads);
  Py_RETURN_NONE;
}

// Program with fixed arrays for its first inputs and for all outputs but the last.
struct Bound {
  static constexpr char CAPSULE[] = "batchpid.bound_program";

  ~Bound() {
    Py_XDECREF(kept);
    for (PyObject *output : latest) Py_XDECREF(output);
  }

  PyObject *kept = nullptr;  // arguments of bind, among them the program and the arrays
  PyObject *latest[2] = {};  // last outputs made by calls, if they are large
  PyObject *output;  // arguments of numpy.empty
  Program const *program;
  Index rows;
  int threads;
  unsigned given, full;  // bits of the further inputs
  std::vector<Input> inputs;
  std::vector<Output> outputs;
};
constexpr std::size_t MOST = 32;  // inputs, outputs
// Least bytes of an output that is kept to be written again: the page faults of a new one cost a fifth of a step.
constexpr Index LARGE_OUTPUT = 1 << 20;

// Return a new output, or one of the latest if nobody else holds it; views of an array hold it, too. In a loop
// `effort = pid(...)` the caller holds the last output during a call, so there are two.
PyObject *make_output(Bound &bound) {
  for (PyObject *output : bound.latest) {
    if (output == nullptr || Py_REFCNT(output) != 1) continue;
    Py_INCREF(output);
    return output;
  }
  PyObject *output = PyObject_Call(make_empty, bound.output, nullptr);
  if (output == nullptr || bound.rows * bound.program->columns * bound.program->itemsize() < LARGE_OUTPUT) return output;
  Py_XDECREF(bound.latest[0]);
  bound.latest[0] = bound.latest[1];
  bound.latest[1] = output;
  Py_INCREF(output);
  return output;
}

// bind(program, rows, inputs, outputs, given, full, output, threads): fix the first inputs and outputs. Bits of `given`
// mark further inputs that are arrays (not None), bits of `full` those that must be (rows, columns). `output` holds the
// arguments of numpy.empty for the last output.
PyObject *bind(PyObject *, PyObject *arguments) {
  PyObject *capsule, *read, *written;
  auto bound = std::make_unique<Bound>();
  if (!PyArg_ParseTuple(arguments, "OnO!O!IIO!i", &capsule, &bound->rows, &PyTuple_Type, &read, &PyTuple_Type, &written,
                        &bound->given, &bound->full, &PyTuple_Type, &bound->output, &bound->threads)) {
    return nullptr;
  }
  bound->program = held<Program>(capsule);
  if (bound->program == nullptr) return nullptr;
  Program const &program = *bound->program;
  bool good = read_all(program, bound->rows, read, bound->inputs, read_input) &&
              read_all(program, bound->rows, written, bound->outputs, read_output);
  auto inputs = bound->inputs;
  auto outputs = bound->outputs;
  inputs.resize(static_cast<std::size_t>(program.inputs), {nullptr, Shape::FULL});
  outputs.push_back({nullptr, false});
  good = good && inputs.size() <= MOST && outputs.size() <= MOST && bound->inputs.size() <= inputs.size();
  if (!good || !fits(program, bound->rows, inputs, outputs)) return misfit();
  bound->kept = arguments;
  Py_INCREF(arguments);
  return capsule_of(std::move(bound));
}

// call(bound, out, *arrays): write and return the last output, a new array if out is None. Do nothing and return
// NotImplemented if an array is not a plain ndarray of a shape that broadcasts.
PyObject *call(PyObject *, PyObject *const *arguments, Py_ssize_t count) {
  auto *bound = held<Bound>(arguments[0]);
  if (bound == nullptr) return nullptr;
  Program const &program = *bound->program;
  Input inputs[MOST];
  Output outputs[MOST];
  std::size_t read = bound->inputs.size();
  std::size_t const written = bound->outputs.size();
  std::copy_n(bound->inputs.data(), read, inputs);
  std::copy_n(bound->outputs.data(), written, outputs);
  unsigned given = 0;
  bool good = true;
  for (Py_ssize_t i = 2; i < count && good; ++i) {
    unsigned const bit = 1u << (i - 2);
    if (arguments[i] == Py_None) continue;
    given |= bit;
    good = (bound->given & bit) && read_input(program, bound->rows, arguments[i], inputs[read]) &&
           (inputs[read].shape == Shape::FULL || (!(bound->full & bit) && inputs[read].shape != Shape::TABLE));
    ++read;
  }
  PyObject *out = arguments[1];
  bool const is_new = out == Py_None;
  good = good && given == bound->given;
  if (good && !is_new) {
    good = read_output(program, bound->rows, out, outputs[written]) && !outputs[written].is_mask;
    for (std::size_t i = 0; i < read && good; ++i) good = !overlaps(program, bound->rows, outputs[written], inputs[i]);
  }
  if (!good) {
    Py_INCREF(Py_NotImplemented);
    return Py_NotImplemented;
  }
  if (!is_new) {
    Py_INCREF(out);
  } else {
    out = make_output(*bound);
    if (out == nullptr) return nullptr;
    if (!read_output(program, bound->rows, out, outputs[written])) return Py_DECREF(out), misfit();
  }
  run_all(program, inputs, outputs, bound->rows, bound->threads);
  return out;
}

PyMethodDef METHODS[] = {
    {"use", use, METH_VARARGS, nullptr},
    {"look", look, METH_O, nullptr},
    {"program", make, METH_VARARGS, nullptr},
    {"run", run_arrays, METH_VARARGS, nullptr},
    {"bind", bind, METH_VARARGS, nullptr},
    {"call", method(call), METH_FASTCALL, nullptr},
    {nullptr, nullptr, 0, nullptr},
};
PyModuleDef MODULE = {PyModuleDef_HEAD_INIT, "_program", nullptr, -1, METHODS, nullptr, nullptr, nullptr, nullptr};

}  // namespace

PyMODINIT_FUNC PyInit__program() { return batchpid::make_module(MODULE); }
