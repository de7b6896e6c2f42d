// The tracker of one source.
#include "magloc/track.hpp"

MAGLOC_BEGIN
template <int n>
int64_t follow_source(const magloc_track &p, int64_t begin, int64_t end, double *workspace) {
  Workspace room(workspace);
  Track<Lanes, n> track(p, room);
  if (!workspace) return room.size();
  track.load();
  for (int64_t i = begin; i < end && p.progress[1]; ++i) {
    p.progress[1] = track.follow(p.progress[0]);
    p.progress[0] += p.progress[1];
  }
  track.store();
  return 0;
}
MAGLOC_END

using namespace magloc;

MAGLOC_KERNEL(follow_source, track) {
  return (problem->n_states == 6 ? follow_source<6> : follow_source<9>)(*problem, begin, end, workspace);
}
