// Pose of a rigid body of dipoles: damped Gauss-Newton from many starts side by side, one in each lane, and the search
// without a start. magloc/bodies/fit.py is the readable reference of the fit, magloc/bodies/search.py of the search.
//
// Magnet k stands at x + R p_k with the moment R m_k. A step (dx, psi) leads to x + dx and exp([psi]) R: psi is about
// the array's axes.
#pragma once
#include "channels.hpp"
#include "lane_items.hpp"
#include "linear.hpp"

MAGLOC_BEGIN
// Longest rotation of a step, and longest translation over the way from the nearest magnet to its sensor.
constexpr double longest_turn = 0.5, longest_way = 0.5;
// A body that strays so far has no field that counts, in radii.
constexpr double farthest_pose = 1e3;
constexpr double largest_pose_damping = 1e9, idle_gain = 1e-7;
// Only an optimum that explains the readings, by its chi-square over the channels, ends other starts: a better one may
// lie beside a local one.
constexpr double explained_by_channels = 4.0;

template <class T>
struct PoseState {
  T x[3], R[3][3], chi2, nearest;    // nearest: the largest inverse distance of a magnet from a sensor
  T information[6][6], gradient[6];  // lower triangle of J^T J, and J^T r
};

// An optimum that starts may lead to; NaN if there is none. Chi-square above `limit` is of no use.
struct KnownPose {
  double x[3], R[9], chi2, limit;
};

struct PoseEnds {
  double *pose, *chi2, *covariance;
  int64_t *iterations;
  uint8_t *converged;
  double *nearest;  // inverse distance of a magnet from a sensor, or null

  PoseEnds from(int64_t i) const {
    return {pose + 12 * i,  chi2 + i,      covariance + 36 * i,
            iterations + i, converged + i, nearest ? nearest + i : nullptr};
  }
};

template <class T>
class PoseFit {
  static constexpr int D = 6;
  const magloc_pose_refinement &p_;
  T *const arms_, *const moments_, *const columns_, *const residual_;

 public:
  template <class Channels>
  PoseFit(const magloc_pose_refinement &p, const Channels &c, Workspace &room)
      : p_(p),
        arms_(room.take<T>(3 * p.n_magnets)),
        moments_(room.take<T>(3 * p.n_magnets)),
        columns_(room.take<T>(D * c.n_channels)),
        residual_(room.take<T>(c.n_channels)) {}

  const T *columns() const { return columns_; }    // (n_channels, 6) and (n_channels): of the last linearisation
  const T *residual() const { return residual_; }  // without the common field

  template <class Channels>
  void run(Channels &c, int64_t n, const int64_t *row, const double *start, const KnownPose *known,
           const PoseEnds &out) {
    enum : int { running = 0, converged = 1, failed = 2 };
    PoseState<T> at, trial;
    clear(at), clear(trial);
    T damping = {}, promised = {}, iterations = {}, end = broadcast<T>(failed);
    T known_x[3] = {}, known_R[3][3] = {}, known_chi2 = broadcast<T>(nan), limit = broadcast<T>(infinity);
    int64_t loaded[n_lanes<T>];
    for (int64_t &r : loaded) r = -1;
    LaneItems<T> items(0, n);
    const auto begin = [&](int lane, int64_t k, bool) {
      for (int a = 0; a < 3; ++a) set_lane(trial.x[a], lane, start[12 * k + a]);
      for (int a = 0; a < 9; ++a) set_lane(trial.R[a / 3][a % 3], lane, start[12 * k + 3 + a]);
      set_lane(at.chi2, lane, infinity), set_lane(damping, lane, 1e-3), set_lane(promised, lane, 0.0);
      set_lane(iterations, lane, 0.0), set_lane(end, lane, running);
      if (known) {
        for (int a = 0; a < 3; ++a) set_lane(known_x[a], lane, known[k].x[a]);
        for (int a = 0; a < 9; ++a) set_lane(known_R[a / 3][a % 3], lane, known[k].R[a]);
        set_lane(known_chi2, lane, known[k].chi2), set_lane(limit, lane, known[k].limit);
      }
      if (row[k] != loaded[lane]) loaded[lane] = row[k], c.load(lane, row[k]);
    };
    const auto finish = [&](int lane, int64_t k) {
      for (int a = 0; a < 3; ++a) out.pose[12 * k + a] = get_lane(at.x[a], lane);
      for (int a = 0; a < 9; ++a) out.pose[12 * k + 3 + a] = get_lane(at.R[a / 3][a % 3], lane);
      out.chi2[k] = get_lane(at.chi2, lane);
      if (out.nearest) out.nearest[k] = get_lane(at.nearest, lane);
      out.iterations[k] = (int64_t)get_lane(iterations, lane);
      out.converged[k] = get_lane(end, lane) == converged;
      if (out.converged[k]) fill_covariance(at, lane, out.covariance + 36 * k);
    };
    while (items.refill(end, begin)) {
      linearise(c, trial);

      // Take a trial pose with a lower chi-square, and adapt the damping to how well its gain was predicted.
      const T gained = at.chi2 - trial.chi2;
      const auto taken = gained > 0.0;
      const T worse = 3.0 * maximum(damping, broadcast<T>(0.1));
      const T same = choose(gained < 0.5 * promised, worse, damping);
      const T when_taken = choose(gained > 0.75 * promised, 0.1 * damping, same);
      const T when_refused = 5.0 * maximum(damping, broadcast<T>(1e-4));
      damping = choose(at.chi2 < infinity, choose(taken, when_taken, when_refused), damping);
      T *const to = reinterpret_cast<T *>(&at);
      const T *const from = reinterpret_cast<const T *>(&trial);
      for (unsigned j = 0; j < sizeof(at) / sizeof(T); ++j) to[j] = choose(taken, from[j], to[j]);
      iterations += broadcast<T>(1.0);

      // Judge the pose by what an undamped step would gain.
      T ridge[D], step[D], decrement = {};
      for (int j = 0; j < D; ++j) ridge[j] = 1e-12 * at.information[j][j];
      Ldl<T, D>(at.information, T{}, ridge, 0.0).solve(at.gradient, step);
      for (int j = 0; j < D; ++j) decrement += at.gradient[j] * step[j];
      const T small = p_.tolerance + p_.relative_tolerance * at.chi2, none = broadcast<T>(failed);
      end = choose(iterations >= broadcast<T>((double)p_.max_iterations), none, T{});
      end = choose(damping > largest_pose_damping, none, end);
      end = choose(at.chi2 - 10.0 * decrement > limit, none, end);
      // Where the readings fold, what an undamped step promises never vanishes: steps that gain nothing end there.
      const auto idle = taken & (gained < idle_gain * (1.0 + at.chi2)) & (damping < 10.0);
      end = choose(idle, broadcast<T>(converged), end);
      end = choose(decrement < small, broadcast<T>(converged), end);
      end = choose(decrement < infinity, choose(at.chi2 < infinity, end, none), none);
      end = choose(dot(at.x, at.x) < farthest_pose * farthest_pose, end, none);
      if (known) end = choose(leads_to(at, decrement, known_x, known_R, known_chi2), none, end);

      Ldl<T, D>(at.information, damping, ridge, 0.0).solve(at.gradient, step);
      promised = move(at, step, trial);
      items.release(end, finish);
    }
  }

  // Arms and moments of the magnets in the array's frame; `strength` of each moment, or null.
  void place_magnets(const PoseState<T> &p, const double *strength) {
    for (int64_t k = 0; k < p_.n_magnets; ++k) {
      const double factor = strength ? strength[k] : 1.0;
      for (int i = 0; i < 3; ++i) {
        const double *a = p_.places + 3 * k, *m = p_.moments + 3 * k;
        arms_[3 * k + i] = p.R[i][0] * a[0] + p.R[i][1] * a[1] + p.R[i][2] * a[2];
        moments_[3 * k + i] = factor * (p.R[i][0] * m[0] + p.R[i][1] * m[1] + p.R[i][2] * m[2]);
      }
    }
  }

  // Readings (n_channels) of one magnet of unit strength, placed before, without the common field.
  template <class Channels>
  void read_magnet(const Channels &c, const PoseState<T> &p, int64_t k, double strength, T *readings) const {
    for (int64_t i = c.first(c.n_sensors); i < c.n_channels; ++i) readings[i] = T{};
    for (int64_t s = 0; s < c.n_sensors; ++s) {
      T d[3], b[3];
      for (int i = 0; i < 3; ++i) d[i] = c.sensors[3 * s + i] - p.x[i] - arms_[3 * k + i];
      field(Ray<T>::from(d), reinterpret_cast<const T(&)[3]>(moments_[3 * k]), b);
      for (T &x : b) x *= 1.0 / strength;
      c.read_field(s, b, readings);
    }
    c.template project<1>(readings);
  }

  static void clear(PoseState<T> &state) {
    T *x = reinterpret_cast<T *>(&state);
    for (unsigned j = 0; j < sizeof(state) / sizeof(T); ++j) x[j] = T{};
  }

  // Chi-square and normal equations of the trial poses.
  template <class Channels>
  void linearise(Channels &c, PoseState<T> &p, const double *strength = nullptr) {
    place_magnets(p, strength);
    p.nearest = T{};
    for (int64_t i = c.first(c.n_sensors); i < c.n_channels; ++i) {
      residual_[i] = c.y[i];
      for (int j = 0; j < D; ++j) columns_[D * i + j] = T{};
    }
    for (int64_t s = 0; s < c.n_sensors; ++s) {
      T b[3] = {}, slope[3][3] = {}, way[3], by_place[3][3], by_turn[3][3];
      for (int i = 0; i < 3; ++i) way[i] = c.sensors[3 * s + i] - p.x[i];
      for (int64_t k = 0; k < p_.n_magnets; ++k) {
        const T(&m)[3] = reinterpret_cast<const T(&)[3]>(moments_[3 * k]);
        T d[3], of_magnet[3], g[3][3];
        for (int i = 0; i < 3; ++i) d[i] = way[i] - arms_[3 * k + i];
        const Ray<T> ray = Ray<T>::from(d);
        p.nearest = maximum(p.nearest, ray.inverse_r);
        field(ray, m, of_magnet);
        gradient(ray, m, g);
        for (int i = 0; i < 3; ++i) {
          b[i] += of_magnet[i];
          for (int j = 0; j <= i; ++j) slope[i][j] += g[i][j];
        }
      }
      // A small rotation psi of body and sensor changes the field by psi x b; that of the sensor by slope (psi x way).
      for (int i = 0; i < 3; ++i) {
        const int j = (i + 1) % 3, k = (i + 2) % 3;
        for (int l = 0; l < 3; ++l) by_place[i][l] = -(l > i ? slope[l][i] : slope[i][l]);
        cross(way, by_place[i], by_turn[i]);
        by_turn[i][j] += b[k], by_turn[i][k] -= b[j];
      }
      c.linearise_at(s, b);
      c.fill_residual(s, b, residual_);
      c.template read<D>(s, by_place, columns_ + D * c.first(s));
      c.template read<D>(s, by_turn, columns_ + D * c.first(s) + 3);
    }
    c.template project<1>(residual_);
    c.template project<D>(columns_);
    T information[D][D] = {}, gradient[D] = {}, chi2 = {};
    for (int64_t i = 0; i < c.n_channels; ++i) {
      const T *row = columns_ + D * i;
      chi2 += residual_[i] * residual_[i];
      for (int j = 0; j < D; ++j) {
        gradient[j] += row[j] * residual_[i];
        for (int k = 0; k <= j; ++k) information[j][k] += row[j] * row[k];
      }
    }
    p.chi2 = chi2;
    for (int j = 0; j < D; ++j) {
      p.gradient[j] = gradient[j];
      for (int k = 0; k <= j; ++k) p.information[j][k] = information[j][k];
    }
  }

 private:
  // The trial pose after a step of bounded length; by how much it promises to lower chi-square.
  static T move(const PoseState<T> &at, T (&step)[D], PoseState<T> &trial) {
    const T way2 = (step[0] * step[0] + step[1] * step[1] + step[2] * step[2]) * at.nearest * at.nearest;
    const T turn2 = step[3] * step[3] + step[4] * step[4] + step[5] * step[5];
    const T long2 = maximum(way2 * (1.0 / (longest_way * longest_way)), turn2 * (1.0 / (longest_turn * longest_turn)));
    const T share = choose(long2 > 1.0, inverse_root(long2), broadcast<T>(1.0));
    for (T &x : step) x *= share;
    T promised = {};
    for (int j = 0; j < D; ++j) {
      T curvature = {};
      for (int k = 0; k < D; ++k) curvature += at.information[j > k ? j : k][j > k ? k : j] * step[k];
      promised += step[j] * (2.0 * at.gradient[j] - curvature);
    }
    for (int a = 0; a < 3; ++a) trial.x[a] = at.x[a] + step[a];
    const T turn[3] = {step[3], step[4], step[5]};
    rotate(turn, at.R, trial.R);
    return promised;
  }

 public:
  // Rotate by a small vector, to its second order, as the unit quaternion (psi/2, 1) does; R stays a rotation.
  static MAGLOC_INLINE void rotate(const T (&psi)[3], const T (&R)[3][3], T (&result)[3][3]) {
    const T h[3] = {0.5 * psi[0], 0.5 * psi[1], 0.5 * psi[2]}, scale = 2.0 / (1.0 + dot(h, h));
    for (int j = 0; j < 3; ++j) {
      const T v[3] = {R[0][j], R[1][j], R[2][j]};
      T once[3], twice[3];
      cross(h, v, once);
      for (int i = 0; i < 3; ++i) twice[i] = v[i] + once[i];
      cross(h, twice, once);
      for (int i = 0; i < 3; ++i) result[i][j] = v[i] + scale * once[i];
    }
  }

 private:
  // Whether poses are so near a known optimum that they lead to it, as far as their chi-square promises the same.
  MAGLOC_INLINE static auto leads_to(const PoseState<T> &at, const T &decrement, const T (&x)[3], const T (&R)[3][3],
                                     const T &chi2) {
    constexpr double beside2 = 0.0025, share = 0.3;
    T way2 = {}, turn2 = {};
    for (int i = 0; i < 3; ++i) {
      way2 += (at.x[i] - x[i]) * (at.x[i] - x[i]);
      for (int j = 0; j < 3; ++j) turn2 += (at.R[i][j] - R[i][j]) * (at.R[i][j] - R[i][j]);
    }
    const T beyond = at.chi2 - decrement - chi2, most = share * decrement + 1e-3;
    return (way2 * at.nearest * at.nearest + 0.5 * turn2 < beside2) & (beyond < most) & (-beyond < most);
  }

  // Inverse of the information, which is scaled to a unit diagonal, of the position in metres and a rotation about the
  // body's axes; NaN if it is singular.
  void fill_covariance(const PoseState<T> &at, int lane, double *covariance) const {
    double scale[D], a[D][D], in_body[D][D];
    for (int j = 0; j < D; ++j) scale[j] = 1.0 / square_root(get_lane(at.information[j][j], lane));
    for (int j = 0; j < D; ++j)
      for (int k = 0; k <= j; ++k) a[j][k] = scale[j] * scale[k] * get_lane(at.information[j][k], lane);
    const double definite = Ldl<double, D>(a, 1e-13).definite();
    invert_and_negate(a);
    for (int j = 0; j < D; ++j)
      for (int k = 0; k <= j; ++k) a[j][k] = a[k][j] = -definite * scale[j] * scale[k] * a[j][k];
    const auto change = [&](const double *row, double *result) {
      for (int j = 0; j < 3; ++j) {
        result[j] = p_.radius * row[j], result[3 + j] = 0.0;
        for (int k = 0; k < 3; ++k) result[3 + j] += row[3 + k] * get_lane(at.R[k][j], lane);
      }
    };
    for (int j = 0; j < D; ++j) {
      double row[D];
      change(a[j], row);
      for (int k = 0; k < D; ++k) in_body[k][j] = row[k];
    }
    for (int j = 0; j < D; ++j) change(in_body[j], covariance + D * j);
  }
};

// Search for the pose that fits a row: the candidates of a table that are most like the readings are refined, and the
// distinct optima are put out, best first.
template <class T, class Channels>
class PoseSearch {
  static constexpr int64_t block = 64, together = 4;
  static constexpr int partial = 16;
  static constexpr double same_way2 = 1e-8, same_turn2 = 1e-8;
  const magloc_pose_search &p_;
  Channels channels_;
  PoseFit<T> fit_;
  const int64_t n_blocks_, n_highest_;
  float *const score_, *const highest_;
  double *const start_;
  KnownPose *const known_;
  int64_t *const row_, *const iterations_;
  uint8_t *const converged_;
  const PoseEnds ends_;

 public:
  static constexpr int64_t rows_together = 16;

  PoseSearch(const magloc_pose_search &p, Workspace &room)
      : p_(p),
        channels_(*p.fit->channels, p.fit->signals, room),
        fit_(*p.fit, channels_, room),
        n_blocks_((p.n_candidates + block - 1) / block),
        n_highest_((n_blocks_ + partial - 1) / partial * partial),
        score_(room.take<float>(n_blocks_ * block)),
        highest_(room.take<float>(n_highest_)),
        start_(room.take<double>(12 * rows_together * p.n_starts)),
        known_(room.take<KnownPose>(rows_together * p.n_starts)),
        row_(room.take<int64_t>(rows_together * p.n_starts)),
        iterations_(room.take<int64_t>(rows_together * p.n_starts)),
        converged_(room.take<uint8_t>(rows_together * p.n_starts)),
        ends_{room.take<double>(12 * rows_together * p.n_starts),
              room.take<double>(rows_together * p.n_starts),
              room.take<double>(36 * rows_together * p.n_starts),
              iterations_,
              converged_,
              room.take<double>(rows_together * p.n_starts)} {}

  // The first starts of all rows come first: what they find ends others that lead there, too.
  void run(int64_t begin, int64_t n_rows) {
    const int64_t n = p_.n_starts, n_first = n < 2 ? n : 2;
    const double explained = explained_by_channels * channels_.n_channels;
    for (int64_t i = 0; i < n_rows; ++i) choose_starts(begin + i, i, n_rows, n_first);
    for (int64_t j = 0; j < n_rows * n; ++j) {
      row_[j] = p_.fit->row[begin + row_[j]];
      known_[j].chi2 = nan, known_[j].limit = infinity;
    }
    fit_.run(channels_, n_rows * n_first, row_, start_, nullptr, ends_);
    for (int64_t i = 0; i < n_rows; ++i) {
      KnownPose known{{}, {}, nan, infinity};
      for (int64_t k = 0; k < n_first; ++k) {
        const int64_t e = n_first * i + k;
        if (!ends_.converged[e] || !(ends_.chi2[e] < explained) || ends_.chi2[e] >= known.limit) continue;
        __builtin_memcpy(known.x, ends_.pose + 12 * e, sizeof(known.x) + sizeof(known.R));
        known.chi2 = ends_.chi2[e], known.limit = ends_.chi2[e] + p_.keep_within;
      }
      for (int64_t k = n_first; k < n; ++k) known_[place(i, k, n_rows, n_first)] = known;
    }
    const int64_t done = n_rows * n_first;
    fit_.run(channels_, n_rows * n - done, row_ + done, start_ + 12 * done, known_ + done, ends_.from(done));
    for (int64_t i = 0; i < n_rows; ++i) put_optima(begin + i, i, n_rows, n_first);
  }

 private:
  int64_t place(int64_t i, int64_t k, int64_t n_rows, int64_t n_first) const {
    return k < n_first ? n_first * i + k : n_first * n_rows + (p_.n_starts - n_first) * i + k - n_first;
  }

  void choose_starts(int64_t row, int64_t i, int64_t n_rows, int64_t n_first) {
    fill_scores(p_.features + p_.n_features * row);
    for (int64_t b = 0; b < n_highest_; ++b)
      highest_[b] = b < n_blocks_ ? largest(score_ + b * block, block) : -__builtin_inff();
    for (int64_t found = 0; found < p_.n_starts;) {
      const float best = largest(highest_, n_highest_);
      const int64_t at = place(i, found, n_rows, n_first);
      row_[at] = i;
      if (!(best > -__builtin_inff())) {  // none is left: the best again
        __builtin_memcpy(start_ + 12 * at, start_ + 12 * place(i, 0, n_rows, n_first), 12 * sizeof(double));
        ++found;
        continue;
      }
      const int64_t b = first_of(best, highest_), j = b * block + first_of(best, score_ + b * block);
      score_[j] = -__builtin_inff();
      highest_[b] = largest(score_ + b * block, block);
      bool near = false;
      for (int64_t k = 0; k < found && !near; ++k)
        near = square_of_distance(start_ + 12 * place(i, k, n_rows, n_first), p_.candidates + 12 * j) <
               p_.apart * p_.apart;
      if (near) continue;
      __builtin_memcpy(start_ + 12 * at, p_.candidates + 12 * j, 12 * sizeof(double));
      ++found;
    }
  }
  // Products of the candidates with the features of a row, four features in a pass.
  void fill_scores(const float *features) {
    const int64_t n = p_.n_candidates, n_features = p_.n_features;
    for (int64_t j = 0; j < n_blocks_ * block; ++j) score_[j] = j < n ? 0.0f : -__builtin_inff();
    for (int64_t f = 0; f < n_features; f += together) {
      const float *column[together];
      float x[together];
      for (int64_t k = 0; k < together; ++k) {
        const bool is_feature = f + k < n_features;
        column[k] = p_.table + (is_feature ? f + k : f) * n, x[k] = is_feature ? features[f + k] : 0.0f;
      }
      for (int64_t j = 0; j < n; ++j)
        score_[j] += x[0] * column[0][j] + x[1] * column[1][j] + x[2] * column[2][j] + x[3] * column[3][j];
    }
  }
  // Largest of n numbers, a multiple of the partial ones, which are independent of each other.
  static float largest(const float *x, int64_t n) {
    float part[partial];
    for (int k = 0; k < partial; ++k) part[k] = x[k];
    for (int64_t i = partial; i < n; i += partial)
      for (int k = 0; k < partial; ++k) part[k] = x[i + k] > part[k] ? x[i + k] : part[k];
    float result = part[0];
    for (int k = 1; k < partial; ++k) result = part[k] > result ? part[k] : result;
    return result;
  }
  static int64_t first_of(float value, const float *x) {
    int64_t i = 0;
    while (x[i] != value) ++i;
    return i;
  }
  static double square_of_distance(const double *a, const double *b) {
    double way2 = 0.0, turn2 = 0.0;
    for (int i = 0; i < 3; ++i) way2 += (a[i] - b[i]) * (a[i] - b[i]);
    for (int i = 3; i < 12; ++i) turn2 += (a[i] - b[i]) * (a[i] - b[i]);
    return way2 + 0.5 * turn2;
  }

  bool is_within(const double *pose) const {
    bool result = pose[3] + pose[7] + pose[11] >= p_.least_trace;
    for (int a = 0; a < 3; ++a) result = result && pose[a] >= p_.low[a] && pose[a] <= p_.high[a];
    return result;
  }
  // How far readings bend over one standard deviation of a pose, in units of the noise.
  double bend_of(int64_t row, int64_t end) const {
    const int64_t n = channels_.n_channels;
    const double *const signals = p_.fit->signals + n * p_.fit->row[row], way = ends_.nearest[end] / p_.fit->radius;
    double square = 0.0, spread = 0.0;
    for (int64_t c = 0; c < n; ++c) square += signals[c] * signals[c];
    for (int a = 0; a < 6; ++a) spread += (a < 3 ? 6.0 * way * way : 0.5) * ends_.covariance[36 * end + 7 * a];
    return spread * square_root(square / (double)channels_.first(channels_.n_sensors));
  }

  void put_optima(int64_t row, int64_t i, int64_t n_rows, int64_t n_first) {
    int64_t *counts = p_.counts + 3 * row, kept = 0;
    const int64_t to = row * p_.n_kept;
    counts[1] = counts[2] = 0;
    for (int64_t k = 0; k < p_.n_starts; ++k) {
      const int64_t e = place(i, k, n_rows, n_first);
      counts[1] += !ends_.converged[e];
      counts[2] += ends_.iterations[e];
    }
    p_.bend[row] = nan, p_.is_plain[row] = Channels::linear;
    while (kept < p_.n_kept) {
      int64_t best = -1;
      for (int64_t k = 0; k < p_.n_starts; ++k) {
        const int64_t e = place(i, k, n_rows, n_first);
        if (ends_.converged[e] && (best < 0 || ends_.chi2[e] < ends_.chi2[best])) best = e;
      }
      if (best < 0 || ends_.chi2[best] > (kept ? p_.chi2[to] : infinity) + p_.keep_within) break;
      ends_.converged[best] = false;
      bool same = false;
      for (int64_t o = to; o < to + kept && !same; ++o)
        same = square_of_distance(ends_.pose + 12 * best, p_.pose + 12 * o) < same_way2 &&
               __builtin_fabs(ends_.chi2[best] - p_.chi2[o]) < 1e-3 * (1.0 + p_.chi2[o]);
      if (same) continue;
      __builtin_memcpy(p_.pose + 12 * (to + kept), ends_.pose + 12 * best, 12 * sizeof(double));
      __builtin_memcpy(p_.covariance + 36 * (to + kept), ends_.covariance + 36 * best, 36 * sizeof(double));
      if (!kept) p_.bend[row] = bend_of(row, best);
      if (!is_within(p_.pose + 12 * (to + kept))) p_.is_plain[row] = 0;
      for (int64_t o = to; o < to + kept; ++o)
        if (square_of_distance(p_.pose + 12 * (to + kept), p_.pose + 12 * o) < p_.apart * p_.apart)
          p_.is_plain[row] = 0;
      p_.chi2[to + kept++] = ends_.chi2[best];
    }
    if (!kept || !(p_.chi2[to] < p_.most_chi2) || !(p_.bend[row] < infinity)) p_.is_plain[row] = 0;
    counts[0] = kept;
    for (int64_t o = to + kept; o < to + p_.n_kept; ++o) {
      for (int a = 0; a < 12; ++a) p_.pose[12 * o + a] = nan;
      for (int a = 0; a < 36; ++a) p_.covariance[36 * o + a] = nan;
      p_.chi2[o] = nan;
    }
  }
};
MAGLOC_END
