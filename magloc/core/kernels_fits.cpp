// Fits of dipoles from starts.
#include "magloc/refine.hpp"

MAGLOC_BEGIN
template <int K, class Channels>
int64_t refine(const magloc_refinement &p, int64_t begin, int64_t end, double *workspace) {
  Workspace room(workspace);
  Channels channels(*p.channels, p.signals, room);
  Refinement<Lanes, K> refinement(channels, room);
  if (!workspace) return room.size();
  const Starts starts{end - begin, p.row + begin, p.start + 4 * K * begin,
                      p.start_moment ? p.start_moment + 3 * K * begin : nullptr,
                      p.too_high ? p.too_high + begin : nullptr};
  const Rules rules{p.tolerance, p.relative_tolerance, p.max_iterations, false, false, p.free};
  const Ends ends{p.q, p.mu, p.chi2, p.iterations, p.converged};
  refinement.run(channels, starts, rules, ends.template from<K>(begin));
  return 0;
}
MAGLOC_END

MAGLOC_KERNEL(refine, refinement) {
  using namespace magloc;
  const magloc_channels &channels = *problem->channels;
  switch (problem->n_sources) {
    case 1:
      if (channels.is_modulus) return refine<1, Moduli<Lanes>>(*problem, begin, end, workspace);
      if (channels.is_isotropic) return refine<1, Isotropic<Lanes>>(*problem, begin, end, workspace);
      return refine<1, General<Lanes>>(*problem, begin, end, workspace);
    case 2:
      if (channels.is_isotropic) return refine<2, Isotropic<Lanes>>(*problem, begin, end, workspace);
      return refine<2, General<Lanes>>(*problem, begin, end, workspace);
    case 3:
      return refine<3, General<Lanes>>(*problem, begin, end, workspace);  // one type compiles in half the time
    default:
      return refine<4, General<Lanes>>(*problem, begin, end, workspace);
  }
}
