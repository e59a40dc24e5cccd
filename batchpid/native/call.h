// Function on arrays that Python owns, for the programs of another extension.

#pragma once

#pragma GCC visibility push(hidden)

namespace batchpid {

struct Call {
  void (*run)(Call const &call);
};

}  // namespace batchpid

#pragma GCC visibility pop
