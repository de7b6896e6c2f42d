// Uncertainty of fits of one source by vector sensors.
#include "magloc/uncertainty.hpp"

MAGLOC_BEGIN
template <class Channels>
int64_t uncertainty(const magloc_source_uncertainty &p, int64_t begin, int64_t end, double *workspace) {
  Workspace room(workspace);
  Uncertainty<Lanes, Channels> uncertainty(p, room);
  if (!workspace) return room.size();
  uncertainty.run(begin, end);
  return 0;
}
MAGLOC_END

MAGLOC_KERNEL(source_uncertainties, source_uncertainty) {
  using namespace magloc;
  return problem->channels->is_isotropic ? uncertainty<Isotropic<Lanes>>(*problem, begin, end, workspace)
                                         : uncertainty<General<Lanes>>(*problem, begin, end, workspace);
}
