// Identification of stars.
#include "adcs/stars.hpp"
#include "magloc/kernel.hpp"

using namespace magloc;

MAGLOC_KERNEL(star_search, star_triangles) {
  if (!workspace) return 0;
  int64_t *looked_up = problem->progress, *tried = problem->progress + 1;
  for (int64_t i = begin; i < end; ++i) {
    if (problem->matched[problem->n_kept - 1] >= problem->n_enough || *tried >= problem->n_most) break;
    if (i < *looked_up) continue;
    try_triangle(*problem, i);
    *looked_up = i + 1;
  }
  return 0;
}
