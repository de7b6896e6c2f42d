// Cramer-Rao bounds of many sources.
#include "magloc/bounds.hpp"

using namespace magloc;

MAGLOC_KERNEL(source_bounds, bounds) {
  Workspace room(workspace);
  Bounds<Lanes> bounds(*problem, room);
  if (!workspace) return room.size();
  for (int64_t i = begin; i < end; i += n_lanes<Lanes>) bounds.run(i, end);
  return 0;
}
