// Filters of the convergence map.
#include "magloc/iekf.hpp"

using namespace magloc;

MAGLOC_KERNEL(filter_starts, starts) {
  Workspace space(workspace);
  // Two groups of lanes in turn: while the divisions of one wait for each other, the processor works at the other.
  StartsFilter<Lanes> first(*problem, space), second(*problem, space);
  if (!workspace) return space.size();
  const int64_t middle = begin + (end - begin) / 2;
  first.set_items(begin, middle);
  second.set_items(middle, end);
  while ((int)first.pass() | (int)second.pass()) {
  }
  return 0;
}
