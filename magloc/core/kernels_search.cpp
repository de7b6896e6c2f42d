// Searches for one dipole without a start.
#include "magloc/search.hpp"

MAGLOC_BEGIN
template <class Channels>
int64_t search(const magloc_search &p, int64_t begin, int64_t end, double *workspace) {
  Workspace room(workspace);
  Search<Lanes, Channels> search(p, room);
  if (!workspace) return room.size();
  for (int64_t i = begin; i < end; i += search.rows_together)
    search.run(i, end - i < search.rows_together ? end - i : search.rows_together);
  return 0;
}
MAGLOC_END

using namespace magloc;

MAGLOC_KERNEL(candidate_bases, candidate_positions) {
  Workspace room(workspace);
  CandidateBases<Lanes> bases(*problem->channels, room);
  if (!workspace) return room.size();
  bases.fill(*problem, begin, end);
  return 0;
}

MAGLOC_KERNEL(choose_candidates, candidate_choice) {
  Workspace room(workspace);
  Choice choice(problem->n_candidates, room);
  if (!workspace) return room.size();
  for (int64_t i = begin; i < end; ++i)
    choice.choose(problem->components + 3 * problem->n_candidates * i, problem->candidates, problem->cosine,
                  problem->n_chosen, problem->chosen + problem->n_chosen * i);
  return 0;
}

MAGLOC_KERNEL(search_optima, search) {
  if (problem->channels->is_modulus) return search<Moduli<Lanes>>(*problem, begin, end, workspace);
  if (problem->channels->is_isotropic) return search<Isotropic<Lanes>>(*problem, begin, end, workspace);
  return search<General<Lanes>>(*problem, begin, end, workspace);
}
