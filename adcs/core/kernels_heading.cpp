// Heading of an inertial unit with a magnetometer.
#include "adcs/heading.hpp"

using namespace magloc;

MAGLOC_KERNEL(heading_filter, heading) {
  Workspace memory(workspace);
  auto *run = memory.take<HeadingRun>(1);
  if (!workspace) return memory.size();
  if (begin == 0) run->start(*problem);
  for (int64_t i = begin; i < end; ++i) run->step(*problem, i);
  return 0;
}

MAGLOC_KERNEL(heading_smoother, heading) {
  const int64_t n = problem->n_blocks;
  Workspace memory(workspace);
  auto *smoother = memory.take<HeadingSmoother>(1);
  auto *filtered = memory.take<HeadingFilter>(n);
  if (!workspace) return memory.size();
  if (begin == 0) smoother->start(*problem);
  for (int64_t i = begin; i < end; ++i) {
    if (i < n)
      smoother->forward(*problem, i, filtered);
    else
      smoother->backward(*problem, 2 * n - 1 - i, filtered);
  }
  return 0;
}
