// Search for one source without a start: bases of candidate positions, the choice of starts, and their optima.
#pragma once
#include "refine.hpp"

MAGLOC_BEGIN
// Orthonormal columns of what the channels read of three unit moments at candidates (n, 4): bases (n_channels, 3, n).
template <class T>
class CandidateBases {
  General<T> channels_;
  T *const columns_, *const nothing_;

 public:
  CandidateBases(const magloc_channels &m, Workspace &room)
      : channels_(m, nullptr, room), columns_(room.take<T>(3 * m.n_channels)), nothing_(room.take<T>(m.n_channels)) {}

  void fill(const magloc_candidate_positions &p, int64_t begin, int64_t end) {
    const int64_t n = channels_.n_channels;
    for (int lane = 0; lane < n_lanes<T>; ++lane) channels_.load_model(lane, 0);
    for (int64_t first = begin; first < end; first += n_lanes<T>) {
      T q[4] = {};
      for (int i = 0; i < n_lanes<T>; ++i)
        for (int d = 0; d < 4; ++d) set_lane(q[d], i, p.candidates[4 * (first + i < end ? first + i : end - 1) + d]);
      for (int64_t s = 0; s < channels_.n_sensors; ++s) {
        T v[3], f[3][3];
        for (int a = 0; a < 3; ++a) v[a] = q[3] * channels_.sensors[3 * s + a] - q[a];
        field_matrix(Ray<T>::from(v), f);
        channels_.template read<3>(s, f, columns_ + 3 * channels_.first(s));
      }
      channels_.template project<3>(columns_);
      for (int64_t c = 0; c < n; ++c) nothing_[c] = T{};
      const Orthogonalisation<T, 3> orthogonal(columns_, nothing_, n, 1e-26);
      for (int j = 0; j < 3; ++j) {
        const T scale = square_root(orthogonal.inverse[j]);
        for (int64_t c = 0; c < n; ++c)
          for (int i = 0; i < n_lanes<T> && first + i < end; ++i)
            p.bases[(3 * c + j) * p.n_candidates + first + i] = (float)get_lane(scale * columns_[3 * c + j], i);
      }
    }
  }
};

// Candidates that explain most of a row, some angle apart: the best first, then the best of those that are not near.
//
// A key is the score's bits: those of positive floats are in order. The largest key of each block of candidates is
// known.
class Choice {
  static constexpr int64_t block = 64;
  const int64_t n_, n_blocks_;
  int32_t *const key_, *const highest_;

  static int32_t largest(const int32_t *keys, int64_t n) {
    int32_t result = keys[0];
    for (int64_t i = 1; i < n; ++i) result = keys[i] > result ? keys[i] : result;
    return result;
  }
  static int64_t first_of(int32_t key, const int32_t *keys, int64_t n) {
    int32_t result = (int32_t)n;
    for (int32_t i = 0; i < (int32_t)n; ++i) {
      const int32_t place = keys[i] == key ? i : (int32_t)n;
      result = place < result ? place : result;
    }
    return result;
  }

 public:
  Choice(int64_t n_candidates, Workspace &room)
      : n_(n_candidates),
        n_blocks_((n_candidates + block - 1) / block),
        key_(room.take<int32_t>(n_blocks_ * block)),
        highest_(room.take<int32_t>(n_blocks_)) {}

  // Components (3, n) of the row along the candidates' bases.
  void choose(const float *components, const double *candidates, double cosine, int64_t n_chosen, int64_t *chosen) {
    const float *x = components, *y = x + n_, *z = y + n_;
    for (int64_t j = 0; j < n_; ++j) {
      const float energy = x[j] * x[j] + y[j] * y[j] + z[j] * z[j], score = energy > 0.0f ? energy : -1.0f;
      __builtin_memcpy(&key_[j], &score, sizeof score);
    }
    for (int64_t j = n_; j < n_blocks_ * block; ++j) key_[j] = none;
    for (int64_t b = 0; b < n_blocks_; ++b) highest_[b] = largest(key_ + b * block, block);
    for (int64_t found = 0; found < n_chosen;) {
      const int32_t best = largest(highest_, n_blocks_);
      if (best <= 0) {  // none is left: the best again
        chosen[found] = found ? chosen[0] : 0;
        ++found;
        continue;
      }
      const int64_t b = first_of(best, highest_, n_blocks_), j = b * block + first_of(best, key_ + b * block, block);
      key_[j] = none;
      highest_[b] = largest(key_ + b * block, block);
      bool near = false;
      for (int64_t k = 0; k < found; ++k) {
        const double *p = candidates + 4 * chosen[k], *q = candidates + 4 * j;
        near |= __builtin_fabs(p[0] * q[0] + p[1] * q[1] + p[2] * q[2] + p[3] * q[3]) > cosine;
      }
      if (!near) chosen[found++] = j;
    }
  }

 private:
  static constexpr int32_t none = -1;
};

// Ends of refinements of one source, in the caller's memory.
struct EndsOfOne : Ends {
  EndsOfOne(int64_t n, Workspace &room) {
    q = room.take<double>(4 * n), mu = room.take<double>(3 * n), chi2 = room.take<double>(n);
    iterations = room.take<int64_t>(n), converged = room.take<uint8_t>(n);
  }
};

// Distinct optima of rows that several starts each lead to. All starts are refined to near an optimum, the first ones
// of each row before the others; then the distinct ends to the optima.
template <class T, class Channels>
class Search {
  // A start is near an optimum, or at one, if Gauss-Newton predicts a smaller gain in chi-square.
  static constexpr double near_tolerance = 1e-2, optimum_tolerance = 1e-10, relative_tolerance = 1e-14;
  // Linearisations allowed from there on, in units of those allowed before: along a flat valley steps stay long.
  static constexpr int64_t times_longer = 3;
  // Starts of a row that are refined before the others, and before all others.
  static constexpr int64_t n_stages = 2, ends_of_stages[n_stages] = {1, 3};
  // Two ends are one optimum if they are 0.01 rad apart on the sphere of q and their chi-squares are equal.
  static constexpr double same_cosine = 0.99995, same_chi2 = 0.01;

  Channels channels_;
  Refinement<T, 1> refinement_;
  const magloc_search &p_;
  const int64_t n_starts_;

 public:
  static constexpr int64_t rows_together = 64;

 private:
  EndsOfOne near_, end_;
  double *const q_, *const mu_, *const limit_, *const known_chi2_;
  KnownOptimum *const known_;
  int64_t *const row_, *const place_, *const order_, *const iterations_, *const first_end_;

 public:
  Search(const magloc_search &p, Workspace &room)
      : channels_(*p.channels, p.signals, room),
        refinement_(channels_, room),
        p_(p),
        n_starts_(p.n_starts),
        near_(rows_together * n_starts_, room),
        end_(rows_together * n_starts_, room),
        q_(room.take<double>(4 * rows_together * n_starts_)),
        mu_(room.take<double>(3 * rows_together * n_starts_)),
        limit_(room.take<double>(rows_together * n_starts_)),
        known_chi2_(room.take<double>(rows_together * n_starts_)),
        known_(room.take<KnownOptimum>(rows_together * n_starts_)),
        row_(room.take<int64_t>(rows_together * n_starts_)),
        place_(room.take<int64_t>(rows_together * n_starts_)),
        order_(room.take<int64_t>(rows_together)),
        iterations_(room.take<int64_t>(rows_together * n_starts_)),
        first_end_(room.take<int64_t>(rows_together + 1)) {}

  void run(int64_t begin, int64_t n_rows) {
    refine_starts(begin, n_rows);
    const int64_t n_distinct = find_distinct(begin, n_rows);
    const Starts starts{n_distinct, row_, q_, p_.start_moments ? mu_ : nullptr, nullptr};
    refinement_.run(channels_, starts, rules(optimum_tolerance, times_longer * p_.max_iterations, false, false), end_);
    for (int64_t i = 0; i < n_rows; ++i) put_optima(begin + i, first_end_[i], first_end_[i + 1]);
  }

 private:
  static Rules rules(double tolerance, int64_t max_iterations, bool ahead, bool few_digits) {
    return {tolerance, relative_tolerance, max_iterations, ahead, few_digits, nullptr};
  }

  // Refine the starts to near an optimum, those of each stage together: what the first ones of a row find tells how
  // high chi-square may be where the others lead, and ends those that lead there, too. Rows for which few digits do
  // come first.
  void refine_starts(int64_t begin, int64_t n_rows) {
    int64_t n_easy = 0, n_hard = 0;
    for (int64_t i = 0; i < n_rows; ++i)
      if (channels_.few_digits_do(p_.row[begin + i]))
        order_[n_easy++] = i;
      else
        order_[n_rows - ++n_hard] = i;
    for (int64_t stage = 0, first = 0; first < n_starts_; ++stage) {
      const int64_t last = stage < n_stages && ends_of_stages[stage] < n_starts_ ? ends_of_stages[stage] : n_starts_;
      refine_stage(begin, n_rows, n_easy, first, last);
      first = last;
    }
  }
  void refine_stage(int64_t begin, int64_t n_rows, int64_t n_easy, int64_t first, int64_t last) {
    int64_t j = n_rows * first;
    for (int64_t at = 0; at < n_rows; ++at) {
      const int64_t i = order_[at], best = lowest(i, first);
      const KnownOptimum known = known_optimum(best);
      for (int64_t k = first; k < last; ++k, ++j) {
        const int64_t from = (begin + i) * n_starts_ + k;
        place_[i * n_starts_ + k] = j;
        row_[j] = p_.row[begin + i];
        limit_[j] = highest_useful(best);
        known_[j] = known;
        for (int d = 0; d < 4; ++d) q_[4 * j + d] = p_.starts[4 * from + d];
        if (p_.start_moments)
          for (int d = 0; d < 3; ++d) mu_[3 * j + d] = p_.start_moments[3 * from + d];
      }
    }
    const int64_t n = last - first, edges[] = {n_rows * first, n_rows * first + n_easy * n, n_rows * last};
    for (int part = 0; part < 2; ++part) {
      const int64_t at = edges[part];
      const Starts starts{edges[part + 1] - at, row_ + at,  q_ + 4 * at, p_.start_moments ? mu_ + 3 * at : nullptr,
                          limit_ + at,          known_ + at};
      refinement_.run(channels_, starts, rules(near_tolerance, p_.max_iterations, true, part == 0), near_.from<1>(at));
    }
  }
  // The best end of the first n starts of a row; -1 if there is none.
  int64_t lowest(int64_t i, int64_t n) const {
    int64_t best = -1;
    for (int64_t k = 0; k < n; ++k) {
      const int64_t j = place_[i * n_starts_ + k];
      if (near_.converged[j] && (best < 0 || near_.chi2[j] < near_.chi2[best])) best = j;
    }
    return best;
  }
  KnownOptimum known_optimum(int64_t end) const {
    KnownOptimum known{{}, {}, nan, 0.0};
    if (end < 0) return known;
    for (int d = 0; d < 4; ++d) known.q[d] = near_.q[4 * end + d];
    for (int d = 0; d < 3; ++d) known.mu[d] = near_.mu[3 * end + d];
    known.chi2 = near_.chi2[end], known.reach2 = 1.0;
    for (int64_t s = 0; s < channels_.n_sensors; ++s) {
      double v[3];
      for (int a = 0; a < 3; ++a) v[a] = known.q[3] * channels_.sensors[3 * s + a] - known.q[a];
      const double square = dot(v, v);
      known.reach2 = square < known.reach2 ? square : known.reach2;
    }
    return known;
  }
  // Chi-square that is of use beside an end.
  double highest_useful(int64_t best) const { return best < 0 ? infinity : near_.chi2[best] + p_.keep_within + 1.0; }

  bool same(const double *q, const double *mu, double chi2, const double *other_q, const double *other_mu,
            double other_chi2) const {
    const double cosine = q[0] * other_q[0] + q[1] * other_q[1] + q[2] * other_q[2] + q[3] * other_q[3];
    if (!(__builtin_fabs(cosine) > same_cosine && __builtin_fabs(chi2 - other_chi2) < same_chi2)) return false;
    // Without an ambient field moduli do not tell opposite moments apart.
    return Channels::linear || mu[0] * other_mu[0] + mu[1] * other_mu[1] + mu[2] * other_mu[2] > 0.0;
  }

  // Gather the distinct ends of each row that may become one of its optima; return their number.
  int64_t find_distinct(int64_t begin, int64_t n_rows) {
    int64_t count = 0;
    for (int64_t i = 0; i < n_rows; ++i) {
      int64_t *counts = p_.counts + 3 * (begin + i);
      counts[1] = counts[2] = 0;
      first_end_[i] = count;
      const double useful = highest_useful(lowest(i, n_starts_));
      for (int64_t k = 0; k < n_starts_; ++k) {
        const int64_t j = place_[i * n_starts_ + k];
        counts[1] += !near_.converged[j];
        counts[2] += near_.iterations[j];
        if (!near_.converged[j] || near_.chi2[j] > useful) continue;
        bool known = false;
        for (int64_t o = first_end_[i]; o < count && !known; ++o)
          known = same(near_.q + 4 * j, near_.mu + 3 * j, near_.chi2[j], q_ + 4 * o, mu_ + 3 * o, known_chi2_[o]);
        if (known) continue;
        for (int d = 0; d < 4; ++d) q_[4 * count + d] = near_.q[4 * j + d];
        for (int d = 0; d < 3; ++d) mu_[3 * count + d] = near_.mu[3 * j + d];
        known_chi2_[count] = near_.chi2[j];
        iterations_[count] = near_.iterations[j];
        row_[count++] = p_.row[begin + i];
      }
    }
    first_end_[n_rows] = count;
    return count;
  }

  // Write the distinct optima of a row among the ends first, ..., last - 1, best first.
  void put_optima(int64_t row, int64_t first, int64_t last) {
    const int64_t at = row * n_starts_;
    int64_t *counts = p_.counts + 3 * row, kept = 0;
    for (int64_t j = first; j < last; ++j) {
      counts[1] += !end_.converged[j];
      counts[2] += end_.iterations[j];
    }
    for (;;) {
      int64_t best = -1;
      for (int64_t j = first; j < last; ++j)
        if (end_.converged[j] && (best < 0 || end_.chi2[j] < end_.chi2[best])) best = j;
      if (best < 0 || end_.chi2[best] > (kept ? p_.chi2[at] : infinity) + p_.keep_within) break;
      end_.converged[best] = false;
      bool known = false;
      for (int64_t o = at; o < at + kept && !known; ++o)
        known = same(end_.q + 4 * best, end_.mu + 3 * best, end_.chi2[best], p_.q + 4 * o, p_.mu + 3 * o, p_.chi2[o]);
      if (known) continue;
      const int64_t to = at + kept++;
      for (int d = 0; d < 4; ++d) p_.q[4 * to + d] = end_.q[4 * best + d];
      for (int d = 0; d < 3; ++d) p_.mu[3 * to + d] = end_.mu[3 * best + d];
      p_.chi2[to] = end_.chi2[best];
      p_.iterations[to] = iterations_[best] + end_.iterations[best];
    }
    counts[0] = kept;
    for (int64_t to = at + kept; to < at + n_starts_; ++to) {
      for (int d = 0; d < 4; ++d) p_.q[4 * to + d] = nan;
      for (int d = 0; d < 3; ++d) p_.mu[3 * to + d] = nan;
      p_.chi2[to] = nan;
      p_.iterations[to] = 0;
    }
  }
};
MAGLOC_END
