// Fits of dipoles from starts.
#include "magloc/refine.hpp"

MAGLOC_BEGIN
// Fits of K sources; several sources only by channels that are linear in the field.
template <int K>
int64_t refine(const magloc_refinement &p, int64_t begin, int64_t end, double *workspace) {
  Workspace room(workspace);
  auto run = [&](auto &channels) {
    Refinement<Lanes, K> refinement(channels, room);
    if (!workspace) return;
    const Starts starts{end - begin, p.row + begin, p.start + 4 * K * begin,
                        p.start_moment ? p.start_moment + 3 * K * begin : nullptr,
                        p.too_high ? p.too_high + begin : nullptr};
    const Rules rules{p.tolerance, p.relative_tolerance, p.max_iterations, false, false, p.free};
    const Ends ends{p.q, p.mu, p.chi2, p.iterations, p.converged};
    refinement.run(channels, starts, rules, ends.template from<K>(begin));
  };
  if constexpr (K == 1)
    with_channels<Lanes>(*p.channels, p.signals, room, run);
  else
    with_linear_channels<Lanes>(*p.channels, p.signals, room, run);
  return workspace ? 0 : room.size();
}
MAGLOC_END

MAGLOC_KERNEL(refine, refinement) {
  using namespace magloc;
  switch (problem->n_sources) {
    case 1:
      return refine<1>(*problem, begin, end, workspace);
    case 2:
      return refine<2>(*problem, begin, end, workspace);
    case 3:
      return refine<3>(*problem, begin, end, workspace);
    default:
      return refine<4>(*problem, begin, end, workspace);
  }
}
