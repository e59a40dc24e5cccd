// Function on arrays that Python owns, for the programs of another extension.

#pragma once

namespace batchpid {

struct Call {
  void (*run)(Call const &call);
};

}  // namespace batchpid
