// Programs of operations on arrays (rows, columns), such as the control law of many envs: traced in Python
// (tracing.py), run here on plain pointers. No Python calls, no exceptions, and no allocation after a thread's first
// run. Every operation is rounded as in NumPy, in float or double; EXP, TANH and SIN are those of the C library.
//
// Rows are processed in blocks that stay in the cache. In a block, an input is read before an output at its address is
// written. An output may therefore be the same array as an input of its shape (state in place). A history is an input
// that the program itself writes to. No other overlap is allowed.
//
// Flags: -O3 -ffp-contract=off -fno-math-errno -fno-trapping-math, and no other part of -ffast-math.

#pragma once

#include "codes.h"

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <limits>
#include <type_traits>
#include <vector>

#if defined(__x86_64__) && defined(__ELF__) && defined(__GLIBC__) && defined(__GNUC__) && !defined(__clang__)
#define BATCHPID_CLONES __attribute__((target_clones("default", "avx2", "avx512f")))
#else
#define BATCHPID_CLONES
#endif
#define BATCHPID_INLINE inline __attribute__((always_inline))

namespace batchpid {

using Index = std::ptrdiff_t;

// Codes of operations beside those of array libraries; masks are 1 and 0.
// PUSH               history, in place: b as its latest sample; the oldest one is lost
// GATHER             columns b of each row of a
// TAKE_ROW           numbers of a table, in row b of the rows of each env and column

struct Operation {
  std::int32_t code, out, operands[3];  // numbers of registers
};

// Shapes of constants and inputs: (), (1, columns), (rows, 1), (rows, columns), (rows, numbers of a table).
// A table is a matrix (columns, columns), or a history (samples, columns) with the latest sample first.
enum class Shape : std::int32_t { NUMBER, ROW, COLUMN, FULL, TABLE };

struct Input {
  void const *data;  // of row 0
  Shape shape;
  Index size = 0;             // numbers in each row of a table
  bool is_writeable = false;  // a history has to be
};
struct Output {
  void *data;    // of row 0 of (rows, columns)
  bool is_mask;  // bytes 0 and 1
};

// Least length of an inner loop over a block. A row that all rows share is repeated to at least this length.
constexpr Index CHUNK = 128;
constexpr Index BLOCK = 8192;  // bytes of a register in a block

template <class T>
struct Operand {
  T const *data;
  Index step;  // numbers to the next chunk, 0 if all chunks are the same; to the next row of a table
};

// One pass over n numbers of a block, in chunks, in place of one pass for each of some consecutive operations.
template <class T>
using Pass = void (*)(Operand<T> const *operands, T *const *results, Index n, Index chunk);

struct Fused {
  std::size_t size;
  std::int32_t const *code;  // of a segment: Segment in tracing.py
  Pass<float> single;
  Pass<double> pass;
};

// Consecutive elementwise operations that are one pass. Segment in tracing.py.
struct Segment {
  Index first, count;                           // of its operations
  std::vector<std::int32_t> operands, results;  // registers
  Pass<float> single;
  Pass<double> pass;
};

// Registers are numbered: constants, inputs, temporaries. A Program is immutable, so any number of threads may run it.
struct Program {
  static constexpr char CAPSULE[] = "batchpid.program";

  bool single = false;  // float, else double
  Index columns = 0, chunk = 0, inputs = 0, registers = 0;
  Index rows = 0;  // of constants (rows, columns)
  std::vector<Operation> operations;
  std::vector<Segment> segments;               // those that have a pass
  std::vector<std::int32_t> results;           // register of each output
  std::vector<Index> made;                     // operation that makes each result; negative: an operand, or twice
  std::vector<Index> last_use;                 // number of the last operation that reads each input
  std::vector<Shape> shapes;                   // of constants: ROW, repeated to a chunk, or FULL
  std::vector<std::vector<double>> constants;  // of numbers of the program's type

  Index itemsize() const { return single ? sizeof(float) : sizeof(double); }
};

namespace detail {

// 0 plus the sum of n products, in NumPy's order for n <= 128: sequential below eight terms, else eight partial sums.
template <class T>
BATCHPID_INLINE T sum_of_products(T const *a, T const *b, Index n) {
  typedef T Four __attribute__((vector_size(4 * sizeof(T))));
  typedef std::conditional_t<sizeof(T) == sizeof(float), std::int32_t, std::int64_t> Place;
  typedef Place Places __attribute__((vector_size(4 * sizeof(T))));
  T sum = T(-0.0);
  Index i = 0;
  if (n >= 8) {
    Four low{}, high{}, x[2], y[2];
    for (; i + 8 <= n; i += 8) {
      std::memcpy(x, a + i, sizeof x);
      std::memcpy(y, b + i, sizeof y);
      low += x[0] * y[0];
      high += x[1] * y[1];
    }
    Four const s = __builtin_shuffle(low, high, Places{0, 4, 2, 6}) + __builtin_shuffle(low, high, Places{1, 5, 3, 7});
    sum = (s[0] + s[2]) + (s[1] + s[3]);
  }
  for (; i < n; ++i) sum += a[i] * b[i];
  return T(0) + sum;
}

// Result of an elementwise operation on one number of each operand.
template <Code code, class T>
BATCHPID_INLINE T result_of(T a, T b, T c) {
  auto const larger = [](T x, T y) { return (x > y) | (x != x) ? x : y; };
  auto const smaller = [](T x, T y) { return (x < y) | (x != x) ? x : y; };
  switch (code) {
    case ADD: return a + b;
    case SUBTRACT: return a - b;
    case MULTIPLY: case AND: return a * b;
    case DIVIDE: return a / b;
    case MAXIMUM: case OR: return larger(a, b);
    case MINIMUM: return smaller(a, b);
    case GREATER: return a > b ? 1 : 0;
    case GREATER_EQUAL: return a >= b ? 1 : 0;
    case LESS: return a < b ? 1 : 0;
    case LESS_EQUAL: return a <= b ? 1 : 0;
    case EQUAL: return a == b ? 1 : 0;
    case NOT_EQUAL: return a != b ? 1 : 0;
    case NOT: return 1 - a;
    case NEGATIVE: return -a;
    case ABSOLUTE: return std::fabs(a);
    case RINT: return std::nearbyint(a);
    case CEIL: return std::ceil(a);
    case FLOOR: return std::floor(a);
    case SQRT: return std::sqrt(a);
    case EXP: return std::exp(a);
    case TANH: return std::tanh(a);
    case SIN: return std::sin(a);
    case SIGN: return a > 0 ? 1 : a < 0 ? -1 : a == 0 ? 0 : a;
    case ISFINITE: return a - a == 0 ? 1 : 0;
    case WHERE: return a != 0 ? b : c;
    default: return a;
  }
}

// Apply an operation to n numbers, whole rows, from number `first` of the arrays on. A table begins with row 0.
template <class T>
BATCHPID_INLINE void apply(Program const &program, Code code, Index first, Index n, T *out, Operand<T> x, Operand<T> y,
                           Operand<T> z) {
  Index const columns = program.columns, chunk = x.step && y.step && z.step ? n : program.chunk;
#define EACH(code)                                                                             \
  case code:                                                                                   \
    for (Index start = 0; start < n; start += chunk) {                                         \
      T const *a = x.data, *b = y.data, *c = z.data;                                           \
      T *o = out + start;                                                                      \
      Index const count = std::min(chunk, n - start);                                          \
      _Pragma("GCC ivdep") for (Index i = 0; i < count; ++i) o[i] = result_of<code>(a[i], b[i], c[i]); \
      x.data += x.step, y.data += y.step, z.data += z.step;                                    \
    }                                                                                          \
    break;
  switch (code) {
    EACH(ADD) EACH(SUBTRACT) EACH(MULTIPLY) EACH(DIVIDE) EACH(MAXIMUM) EACH(MINIMUM) EACH(GREATER) EACH(GREATER_EQUAL)
    EACH(LESS) EACH(LESS_EQUAL) EACH(EQUAL) EACH(NOT_EQUAL) EACH(AND) EACH(OR) EACH(NOT) EACH(NEGATIVE) EACH(ABSOLUTE)
    EACH(RINT) EACH(CEIL) EACH(FLOOR) EACH(SQRT) EACH(EXP) EACH(TANH) EACH(SIN) EACH(SIGN) EACH(ISFINITE) EACH(WHERE)
    case ROW_MINIMUM:
      for (Index row = 0; row < n; row += columns) {
        T const *a = x.data + (x.step ? row : row % program.chunk);
        T least = a[0];
        bool is_nan = false;  // counted apart, so that the loop has no branch
        for (Index i = 0; i < columns; ++i) is_nan |= a[i] != a[i], least = least < a[i] ? least : a[i];
        if (is_nan) least = std::numeric_limits<T>::quiet_NaN();
        std::fill_n(out + row, columns, least);
      }
      break;
    case MATRIX_VECTOR:  // x (rows, columns, columns)
      for (Index row = 0; row < n; row += columns) {
        T const *b = y.data + (y.step ? row : row % program.chunk);
        for (Index i = row; i < row + columns; ++i) out[i] = sum_of_products(x.data + (first + i) * columns, b, columns);
      }
      break;
    case PUSH:
      for (Index row = 0; row < n; row += columns) {
        T *latest = const_cast<T *>(x.data) + (first + row) / columns * x.step, *end = latest + x.step;
        std::copy_backward(latest, end - columns, end);
        std::copy_n(y.data + (y.step ? row : row % program.chunk), columns, latest);
      }
      break;
    case TAKE_ROW:
      for (Index row = 0; row < n; row += columns) {  // a place beyond the table, or NaN, is one in it
        T const *table = x.data + (first + row) / columns * x.step, last = static_cast<T>(x.step / columns - 1);
        T const *b = y.data + (y.step ? row : row % program.chunk);
        for (Index i = 0; i < columns; ++i) {
          auto const place = static_cast<Index>(b[i] > 0 ? std::min(b[i], last) : T(0));
          out[row + i] = table[place * columns + i];
        }
      }
      break;
    case GATHER:
      for (Index row = 0; row < n; row += columns) {
        T const *a = x.data + (x.step ? row : row % program.chunk);
        T const *b = y.data + (y.step ? row : row % program.chunk);
        for (Index i = 0; i < columns; ++i) out[row + i] = a[static_cast<Index>(b[i])];
      }
      break;
  }
#undef EACH
}

// Write n numbers of a register.
template <class T>
BATCHPID_INLINE void write(Output const &output, Index at, Index n, Index chunk, Operand<T> from) {
  if (from.step) chunk = n;
  for (Index start = 0; start < n; start += chunk, from.data += from.step) {
    Index const count = std::min(chunk, n - start);
    if (output.is_mask) {
      char *to = static_cast<char *>(output.data) + at + start;
      for (Index i = 0; i < count; ++i) to[i] = from.data[i] != 0;
    } else if (T *to = static_cast<T *>(output.data) + at + start; to != from.data) {
      for (Index i = 0; i < count; ++i) to[i] = from.data[i];
    }
  }
}

// Work area of the calling thread, of at least this many bytes; it grows, and is freed with the thread.
inline char *work_area(std::size_t bytes) {
  constexpr std::size_t LINE = 64;
  thread_local std::vector<char> area;
  if (area.size() < bytes + LINE) area.resize(bytes + LINE);
  return area.data() + (LINE - reinterpret_cast<std::uintptr_t>(area.data()) % LINE);
}

// Bytes of a block's registers, and of their table.
inline std::size_t work_size(Program const &program, Index block) {
  std::size_t const padded = static_cast<std::size_t>(block * program.itemsize() + 127) / 64 * 64;
  auto const slots = static_cast<std::size_t>(program.registers) - program.constants.size();
  return static_cast<std::size_t>(program.registers) * sizeof(Operand<double>) + 64 + slots * padded;
}

// Return whether a result can be computed in its output: no later operation reads an input at the same address.
inline bool is_made_in_place(Program const &program, Input const *inputs, Output const *outputs, std::size_t result) {
  Index const made = program.made[result];
  if (made < 0 || outputs[result].is_mask) return false;
  for (Index i = 0; i < program.inputs; ++i) {
    if (inputs[i].data == outputs[result].data && program.last_use[static_cast<std::size_t>(i)] > made) return false;
  }
  return true;
}

// Run a segment on n numbers of the registers `at`.
template <class T>
BATCHPID_INLINE void run_segment(Segment const &segment, Operand<T> const *at, Index n, Index chunk) {
  Operand<T> operands[MOST_OPERANDS];
  T *results[MOST_OPERANDS];
  for (std::size_t i = 0; i < segment.operands.size(); ++i) operands[i] = at[segment.operands[i]];
  for (std::size_t i = 0; i < segment.results.size(); ++i) results[i] = const_cast<T *>(at[segment.results[i]].data);
  if constexpr (sizeof(T) == sizeof(float)) {
    segment.single(operands, results, n, chunk);
  } else {
    segment.pass(operands, results, n, chunk);
  }
}

template <class T>
BATCHPID_INLINE void run_rows(Program const &program, Input const *inputs, Output const *outputs, Index first,
                              Index rows) {
  Index const columns = program.columns, chunk = program.chunk, last = (first + rows) * columns;
  Index const most = BLOCK / static_cast<Index>(sizeof(T)) / chunk, all = (rows * columns + chunk - 1) / chunk;
  Index const block = std::min(std::max<Index>(1, most), all) * chunk;
  Index const slot = static_cast<Index>((block * sizeof(T) + 127) / 64 * 64 / sizeof(T));
  auto const constants = static_cast<Index>(program.constants.size());
  char *area = work_area(work_size(program, block));
  auto *at = reinterpret_cast<Operand<T> *>(area);
  T *slots = reinterpret_cast<T *>(area + (program.registers * sizeof(Operand<T>) + 63) / 64 * 64);
  for (Index i = 0; i < program.inputs; ++i) {  // inputs that all blocks share
    T *repeated = slots + i * slot;
    auto const *from = static_cast<T const *>(inputs[i].data);
    at[constants + i] = {repeated, inputs[i].shape == Shape::COLUMN ? chunk : 0};
    if (inputs[i].shape == Shape::TABLE) at[constants + i] = {from, inputs[i].size};
    if (inputs[i].shape == Shape::NUMBER) std::fill_n(repeated, chunk, from[0]);
    if (inputs[i].shape != Shape::ROW) continue;
    for (Index row = 0; row < chunk; row += columns) std::copy_n(from, columns, repeated + row);
  }
  for (Index i = constants + program.inputs; i < program.registers; ++i) at[i] = {slots + (i - constants) * slot, chunk};
  std::uint64_t in_place = 0;  // bits of the first 64 results
  for (std::size_t i = 0; i < std::min<std::size_t>(64, program.results.size()); ++i) {
    in_place |= std::uint64_t{is_made_in_place(program, inputs, outputs, i)} << i;
  }
  for (Index start = first * columns; start < last; start += block) {
    Index const n = std::min(block, last - start), row = start / columns;
    for (Index i = 0; i < constants; ++i) {
      auto const *from = reinterpret_cast<T const *>(program.constants[i].data());
      at[i] = program.shapes[i] == Shape::FULL ? Operand<T>{from + start, chunk} : Operand<T>{from, 0};
    }
    for (Index i = 0; i < program.inputs; ++i) {
      auto const *from = static_cast<T const *>(inputs[i].data);
      if (inputs[i].shape == Shape::FULL) at[constants + i] = {from + start, chunk};
      if (inputs[i].shape != Shape::COLUMN) continue;
      T *repeated = slots + i * slot;
      for (Index j = 0; j * columns < n; ++j) std::fill_n(repeated + j * columns, columns, from[row + j]);
    }
    for (std::size_t i = 0; i < program.results.size(); ++i) {
      if (i < 64 && in_place >> i & 1) at[program.results[i]] = {static_cast<T *>(outputs[i].data) + start, chunk};
    }
    auto segment = program.segments.begin();
    for (Index k = 0; k < static_cast<Index>(program.operations.size()); ++k) {
      if (segment != program.segments.end() && segment->first == k) {
        run_segment(*segment, at, n, chunk);
        k += segment->count - 1;
        ++segment;
        continue;
      }
      Operation const &each = program.operations[static_cast<std::size_t>(k)];
      auto const *operands = each.operands;
      apply(program, static_cast<Code>(each.code), start, n, const_cast<T *>(at[each.out].data), at[operands[0]],
            at[operands[1]], at[operands[2]]);
    }
    for (std::size_t i = 0; i < program.results.size(); ++i) {
      write(outputs[i], start, n, chunk, at[program.results[i]]);
    }
  }
}

BATCHPID_CLONES static void run_double(Program const &program, Input const *inputs, Output const *outputs, Index first,
                                       Index rows) {
  run_rows<double>(program, inputs, outputs, first, rows);
}

}  // namespace detail

// Run a program of doubles on some rows; inputs and outputs have its type and number. Tables have to fit:
// make_program.h.
inline void run(Program const &program, Input const *inputs, Output const *outputs, Index first_row, Index rows) {
  detail::run_double(program, inputs, outputs, first_row, rows);
}

}  // namespace batchpid
