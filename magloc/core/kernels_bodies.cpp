// Poses of rigid bodies of several magnets.
#include "magloc/pose_track.hpp"

MAGLOC_BEGIN
template <class Channels>
int64_t refine_poses(const magloc_pose_refinement &p, int64_t begin, int64_t end, double *workspace) {
  Workspace room(workspace);
  Channels channels(*p.channels, p.signals, room);
  PoseFit<Lanes> fit(p, channels, room);
  if (!workspace) return room.size();
  const PoseEnds ends{p.pose, p.chi2, p.covariance, p.iterations, p.converged, nullptr};
  fit.run(channels, end - begin, p.row + begin, p.start + 12 * begin, nullptr, ends.from(begin));
  return 0;
}

template <class Channels>
int64_t search_poses(const magloc_pose_search &p, int64_t begin, int64_t end, double *workspace) {
  Workspace room(workspace);
  PoseSearch<Lanes, Channels> search(p, room);
  if (!workspace) return room.size();
  for (int64_t i = begin; i < end; i += search.rows_together)
    search.run(i, end - i < search.rows_together ? end - i : search.rows_together);
  return 0;
}

template <class Channels>
int64_t follow_body(const magloc_pose_track &p, int64_t begin, int64_t end, double *workspace) {
  Workspace room(workspace);
  BodyFilter<Channels> filter(p, room);
  if (!workspace) return room.size();
  for (int64_t i = begin; i < end; ++i) filter.follow(i);
  return 0;
}
MAGLOC_END

using namespace magloc;

MAGLOC_KERNEL(refine_poses, pose_refinement) {
  if (problem->channels->is_modulus) return refine_poses<Moduli<Lanes>>(*problem, begin, end, workspace);
  return refine_poses<General<Lanes>>(*problem, begin, end, workspace);
}

MAGLOC_KERNEL(search_poses, pose_search) {
  if (problem->fit->channels->is_modulus) return search_poses<Moduli<Lanes>>(*problem, begin, end, workspace);
  return search_poses<General<Lanes>>(*problem, begin, end, workspace);
}

MAGLOC_KERNEL(follow_body, pose_track) {
  if (problem->fit->channels->is_modulus) return follow_body<Moduli<double>>(*problem, begin, end, workspace);
  return follow_body<General<double>>(*problem, begin, end, workspace);
}
