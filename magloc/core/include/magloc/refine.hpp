// Least squares of K dipoles: damped Gauss-Newton over the positions, with the moments eliminated (variable
// projection), from many starts side by side, one in each lane.
//
// A position is q = (u, s) on the unit sphere of R^4: u/s in units of the array's radius, so that infinity is an
// ordinary point. A moment is scaled by |s|^3. Of channels that are not linear in the moment, such as moduli, the
// moments are fitted to channels linearised about the field of the trial state.
#pragma once
#include "channels.hpp"
#include "lane_items.hpp"
#include "linear.hpp"

MAGLOC_BEGIN
// |s| stays above this: no array resolves a range of 1e5 radii, and differences of its field have no digits there.
constexpr double smallest_s = 1e-5;
// A start is given up if this many times the gain that Gauss-Newton predicts would leave its chi-square too high.
constexpr double most_gained = 10.0;
constexpr double longest_step = 0.5, largest_damping = 1e12;
// A start ends at a known optimum that explains the readings (others may be local ones beside a better one) if a step
// leads to it, but for a share of its length, and promises its chi-square, but for a share of the promise. Lengths that
// count are these shares, at least and at most, of the way from the optimum to the nearest sensor. Channels that are
// not linear follow what a step promises less far.
constexpr double share_beside = 0.4, share_beside_moduli = 0.1, least_length = 0.1, most_length = 0.5;
constexpr double explained_chi2_by_channels = 4.0;

enum End : int { running = 0, converged = 1, failed = 2 };

// A refinement ends when a Gauss-Newton step would lower chi-square by less than the tolerance, after max_iterations
// accepted steps, or when its chi-square cannot come below too_high.
struct Rules {
  double tolerance, relative_tolerance;
  int64_t max_iterations;
  bool ahead;           // put out where the next step leads, with the chi-square that it promises
  bool few_digits;      // form the normal equations from sums of products: faster, for isotropic noise
  const uint8_t *free;  // (K, 3), which tangents of each source may be followed; null: all
};

// An optimum of one source that starts of a row may lead to; its chi-square is NaN if there is none. Reach is the
// square of the way to the nearest sensor on the sphere of q.
struct KnownOptimum {
  double q[4], mu[3], chi2, reach2;
};

struct Starts {
  int64_t n;
  const int64_t *row;      // (n,) of the readings
  const double *q, *mu;    // (n, K, 4), and (n, K, 3) moments to linearise about first, or null; zero: none is known
  const double *too_high;  // (n,) or null
  const KnownOptimum *known = nullptr;  // (n,) or null
};

struct Ends {
  double *q, *mu, *chi2;
  int64_t *iterations;
  uint8_t *converged;

  template <int K>
  Ends from(int64_t i) const {
    return {q + 4 * K * i, mu + 3 * K * i, chi2 + i, iterations + i, converged + i};
  }
};

template <class T, int K>
struct State {
  static constexpr int D = 3 * K;
  T q[K][4], mu[K][3], chi2;
  T gain_by_moments;                 // by how much other moments would lower chi-square: zero for linear channels
  T information[D][D], gradient[D];  // lower triangle of J^T J, and J^T r, J being free of the moments' columns
};

template <class T, int K>
class Refinement {
  static constexpr int D = 3 * K, n_fits_of_moments = 2;
  // Squares of which less is left are rounding. Columns of several sources become one sooner.
  static constexpr double lost_column = K == 1 ? 1e-26 : 1e-13, lost_pivot = K == 1 ? 0.0 : 1e-13;
  Ray<T> *const rays_;
  T *const by_moment_, *const by_position_, *const residual_;

 public:
  template <class Channels>
  Refinement(const Channels &c, Workspace &room)
      : rays_(room.take<Ray<T>>(K * c.n_sensors)),
        by_moment_(room.take<T>(D * c.n_channels)),
        by_position_(room.take<T>(D * c.n_channels)),
        residual_(room.take<T>(c.n_channels)) {}

  template <class Channels>
  void run(Channels &c, const Starts &starts, const Rules &rules, const Ends &out) {
    State<T, K> at, trial;
    clear(at), clear(trial);
    KnownOfLanes known;
    T first_mu[K][3] = {}, damping = {}, promised = {}, iterations = {}, limit = {}, end = broadcast<T>(failed);
    int64_t loaded[n_lanes<T>];
    for (int64_t &row : loaded) row = -1;
    LaneItems<T> items(0, starts.n);
    const auto begin = [&](int lane, int64_t k, bool) {
      const int64_t row = starts.row[k];
      for (int d = 0; d < 4 * K; ++d) set_lane(trial.q[d / 4][d % 4], lane, starts.q[4 * K * k + d]);
      for (int d = 0; d < D; ++d) {
        const double m = starts.mu ? starts.mu[D * k + d] : 0.0;
        set_lane(trial.mu[d / 3][d % 3], lane, m);
        set_lane(first_mu[d / 3][d % 3], lane, m);
      }
      set_lane(at.chi2, lane, infinity), set_lane(damping, lane, 1e-3), set_lane(promised, lane, 0.0);
      set_lane(iterations, lane, 0.0), set_lane(end, lane, running);
      set_lane(limit, lane, starts.too_high ? starts.too_high[k] : infinity);
      if (starts.known) known.load(lane, starts.known[k], explained_chi2_by_channels * c.n_channels);
      if (row != loaded[lane]) loaded[lane] = row, c.load(lane, row);
    };
    const auto finish = [&](int lane, int64_t k) {
      for (int d = 0; d < 4 * K; ++d) out.q[4 * K * k + d] = get_lane((rules.ahead ? trial : at).q[d / 4][d % 4], lane);
      for (int d = 0; d < D; ++d) out.mu[D * k + d] = get_lane(at.mu[d / 3][d % 3], lane);
      out.chi2[k] = get_lane(at.chi2, lane) - (rules.ahead ? get_lane(promised, lane) : 0.0);
      out.iterations[k] = (int64_t)get_lane(iterations, lane);
      out.converged[k] = get_lane(end, lane) == converged;
    };
    while (items.refill(end, begin)) {
      linearise(c, trial, first_mu, at.chi2, rules);

      // Take a trial state with a lower chi-square, and adapt the damping to how well its gain was predicted.
      const T gained = at.chi2 - trial.chi2;
      const auto taken = gained > 0.0;
      const T less = choose(gained > 0.75 * promised, 0.1 * damping, damping);
      const T more = 3.0 * maximum(damping, broadcast<T>(0.1));
      const T when_taken = choose(gained < 0.5 * promised, more, less);
      const T when_refused = 5.0 * maximum(damping, broadcast<T>(1e-4));
      damping = choose(at.chi2 < infinity, choose(taken, when_taken, when_refused), damping);
      iterations += choose(taken, broadcast<T>(1.0), T{});
      T *const to = reinterpret_cast<T *>(&at);
      const T *const from = reinterpret_cast<const T *>(&trial);
      for (unsigned j = 0; j < sizeof(at) / sizeof(T); ++j) to[j] = choose(taken, from[j], to[j]);

      // Judge the state by what an undamped step would gain.
      T ridge[D], step[D], decrement = at.gain_by_moments;
      fill_ridge(at, ridge);
      Ldl<T, D>(at.information, T{}, ridge, lost_pivot).solve(at.gradient, step);
      for (int j = 0; j < D; ++j) decrement += at.gradient[j] * step[j];
      // If no representable step lowers chi-square, the state is an optimum provided that nothing much was promised.
      const auto stuck = damping > largest_damping;
      const T small = choose(stuck, 1e-6 * (1.0 + at.chi2), rules.tolerance + rules.relative_tolerance * at.chi2);
      const T going_on = choose(iterations >= broadcast<T>((double)rules.max_iterations), broadcast<T>(failed), T{});
      end = choose(stuck, broadcast<T>(failed), going_on);
      end = choose(at.chi2 - most_gained * decrement > limit, broadcast<T>(converged), end);
      end = choose(decrement < small, broadcast<T>(converged), end);
      end = choose(decrement < infinity, choose(at.chi2 < infinity, end, broadcast<T>(failed)), broadcast<T>(failed));

      Ldl<T, D>(at.information, damping, ridge, lost_pivot).solve(at.gradient, step);
      promised = move(at, step, rules, trial);
      if constexpr (K == 1)
        if (starts.known) known.take_if_near(at, step, trial, promised, end, Channels::linear);
      items.release(end, finish);
    }
  }

 private:
  struct KnownOfLanes {
    T q[4], mu[3], chi2, reach2;

    void load(int lane, const KnownOptimum &known, double explained) {
      for (int d = 0; d < 4; ++d) set_lane(q[d], lane, known.q[d]);
      for (int a = 0; a < 3; ++a) set_lane(mu[a], lane, known.mu[a]);
      set_lane(chi2, lane, known.chi2 < explained ? known.chi2 : nan);
      set_lane(reach2, lane, known.reach2);
    }

    // End at the known optimum where a step from `at` to `trial` leads nearly there.
    MAGLOC_INLINE void take_if_near(State<T, K> &at, const T (&step)[D], State<T, K> &trial, T &promised, T &end,
                                    bool is_linear) const {
      T cosine = {};
      for (int d = 0; d < 4; ++d) cosine += q[d] * trial.q[0][d];
      const T chord2 = 2.0 * (1.0 - choose(cosine < 0.0, -cosine, cosine));
      const double share = is_linear ? share_beside : share_beside_moduli;
      const T least2 = least_length * least_length * reach2, most2 = most_length * most_length * reach2;
      const T length2 = maximum(dot(step, step), least2);
      const T beside2 = share * share * choose(length2 < most2, length2, most2);
      const T beyond = at.chi2 - promised - chi2, most = share * promised;
      auto near = (chord2 < beside2) & (beyond < most) & (-beyond < most) & (end == broadcast<T>(running));
      if (!is_linear) near &= dot(mu, at.mu[0]) > 0.0;  // moduli alone do not tell opposite moments apart
      for (int d = 0; d < 4; ++d) trial.q[0][d] = choose(near, q[d], trial.q[0][d]);
      for (int a = 0; a < 3; ++a) at.mu[0][a] = choose(near, mu[a], at.mu[0][a]);
      promised = choose(near, at.chi2 - chi2, promised);
      end = choose(near, broadcast<T>(converged), end);
    }
  };

  static void clear(State<T, K> &state) {
    T *x = reinterpret_cast<T *>(&state);
    for (unsigned j = 0; j < sizeof(state) / sizeof(T); ++j) x[j] = T{};
  }

  // A little is added to the information of each source, so that directions without any stay where they are.
  static void fill_ridge(const State<T, K> &at, T (&ridge)[D]) {
    for (int k = 0; k < K; ++k) {
      T largest = {};
      for (int j = 3 * k; j < 3 * k + 3; ++j) largest = maximum(largest, at.information[j][j]);
      for (int j = 3 * k; j < 3 * k + 3; ++j) ridge[j] = 1e-14 * largest;
    }
  }

  // Orthonormal tangents of the sphere at q: two that turn u at one range, and one along the range.
  static MAGLOC_INLINE void fill_tangents(const T (&q)[4], const uint8_t *free, T (&t)[3][4]) {
    const T square = q[0] * q[0] + q[1] * q[1] + q[2] * q[2], length = square_root(square);
    const auto off_centre = square > 1e-24;
    const T inverse = choose(off_centre, 1.0 / length, T{});
    const T n[3] = {q[0] * inverse, q[1] * inverse, choose(off_centre, q[2] * inverse, broadcast<T>(1.0))};
    T u[3], v[3];
    magloc::fill_tangents(n, u, v);
    const T rows[3][4] = {
        {u[0], u[1], u[2], T{}}, {v[0], v[1], v[2], T{}}, {n[0] * q[3], n[1] * q[3], n[2] * q[3], -length}};
    for (int j = 0; j < 3; ++j)
      for (int d = 0; d < 4; ++d) t[j][d] = free && !free[j] ? T{} : rows[j][d];
  }

  template <class Channels>
  static MAGLOC_INLINE Ray<T> ray(const Channels &c, const T (&q)[4], int64_t s) {
    T v[3];
    for (int a = 0; a < 3; ++a) v[a] = q[3] * c.sensors[3 * s + a] - q[a];
    return Ray<T>::from(v);
  }

  template <class Channels>
  MAGLOC_INLINE void fill_by_moment(const Channels &c) {
    for (int64_t s = 0; s < c.n_sensors; ++s)
      for (int k = 0; k < K; ++k) {
        T f[3][3];
        field_matrix(rays_[s * K + k], f);
        c.template read<D>(s, f, by_moment_ + c.first(s) * D + 3 * k);
      }
    clear_behind(c, by_moment_);
    c.template project<D>(by_moment_);
  }
  template <class Channels>
  static MAGLOC_INLINE void clear_behind(const Channels &c, T *columns) {
    for (int64_t i = c.first(c.n_sensors) * D; i < c.n_channels * D; ++i) columns[i] = T{};
  }

  // Derivatives f of a source's field at a sensor x along the tangents t.
  static MAGLOC_INLINE void fill_derivatives(const Ray<T> &ray, const T (&mu)[3], const T (&t)[3][4], const double *x,
                                             T (&f)[3][3]) {
    T g[3][3];
    gradient(ray, mu, g);
    for (int j = 0; j < 3; ++j) {
      T moved[3];  // v = s x - u changes with q
      for (int a = 0; a < 3; ++a) moved[a] = t[j][3] * x[a] - t[j][a];
      for (int a = 0; a < 3; ++a) f[a][j] = dot(g[a], moved);
    }
  }

  // Moments, chi-square and normal equations (Kaufman's form) of the trial states. A state that has just begun (its
  // chi-square so far is infinite) keeps the moments that it comes with.
  template <class Channels>
  void linearise(Channels &c, State<T, K> &p, const T (&first_mu)[K][3], T chi2, const Rules &rules) {
    if constexpr (Channels::isotropic && K == 1)
      if (rules.few_digits) return linearise_by_products(c, p, rules);
    const int64_t n = c.n_channels;
    for (int64_t s = 0; s < c.n_sensors; ++s)
      for (int k = 0; k < K; ++k) rays_[s * K + k] = ray(c, p.q[k], s);
    T inverse[D], along[D] = {};
    for (int fit = 0; fit < (Channels::linear ? 1 : n_fits_of_moments); ++fit) {
      if constexpr (!Channels::linear) c.template linearise<K>(rays_, p.mu);
      fill_by_moment(c);
      for (int64_t i = 0; i < n; ++i) residual_[i] = c.y[i];
      const Orthogonalisation<T, D> moments(by_moment_, residual_, n, lost_column);
      moments.solve(reinterpret_cast<T(&)[D]>(p.mu));
      for (int j = 0; j < D; ++j) inverse[j] = moments.inverse[j];
      p.chi2 = moments.rest_square;
    }
    p.gain_by_moments = T{};
    if constexpr (!Channels::linear) {
      for (int k = 0; k < K; ++k) {
        const auto begins = (chi2 == infinity) & (dot(first_mu[k], first_mu[k]) > 0.0);
        for (int a = 0; a < 3; ++a) p.mu[k][a] = choose(begins, first_mu[k][a], p.mu[k][a]);
      }
      c.template residual<K>(rays_, p.mu, residual_);
      p.chi2 = T{};
      for (int64_t i = 0; i < n; ++i) {
        p.chi2 += residual_[i] * residual_[i];
        for (int j = 0; j < D; ++j) along[j] += by_moment_[D * i + j] * residual_[i];
      }
      for (int j = 0; j < D; ++j) p.gain_by_moments += along[j] * along[j] * inverse[j];
    }

    T t[K][3][4], cross[D][D] = {};
    for (int k = 0; k < K; ++k) fill_tangents(p.q[k], rules.free ? rules.free + 3 * k : nullptr, t[k]);
    for (int j = 0; j < D; ++j) {
      p.gradient[j] = T{};
      for (int k = 0; k < D; ++k) p.information[j][k] = T{};
    }
    for (int64_t s = 0; s < c.n_sensors; ++s)
      for (int k = 0; k < K; ++k) {
        T f[3][3];
        fill_derivatives(rays_[s * K + k], p.mu[k], t[k], c.sensors + 3 * s, f);
        c.template read<D>(s, f, by_position_ + c.first(s) * D + 3 * k);
      }
    clear_behind(c, by_position_);
    c.template project<D>(by_position_);
    for (int64_t i = 0; i < n; ++i)
      for (int j = 0; j < D; ++j)
        for (int k = 0; k < D; ++k) cross[j][k] += by_moment_[D * i + j] * by_position_[D * i + k];
    for (int j = 0; j < D; ++j)
      for (int k = 0; k < D; ++k) cross[j][k] *= inverse[j];
    for (int64_t i = 0; i < n; ++i) {
      T *const row = by_position_ + D * i;
      for (int k = 0; k < D; ++k)
        for (int j = 0; j < D; ++j) row[k] -= cross[j][k] * by_moment_[D * i + j];
      for (int j = 0; j < D; ++j) {
        p.gradient[j] += row[j] * residual_[i];
        for (int k = 0; k <= j; ++k) p.information[j][k] += row[j] * row[k];
      }
    }
  }

  // The same for one source and isotropic noise by sums of products alone, in two passes over the sensors: faster, with
  // half the digits. Fields count relative to that at the first sensor; what they have in common is
  // unknown, and the readings are free of it.
  MAGLOC_INLINE void linearise_by_products(const Isotropic<T> &c, State<T, K> &p, const Rules &rules) {
    const T(&mu)[3] = p.mu[0];
    T at_first[3][3], sum[3][3] = {}, square[3][3] = {}, product[3] = {};
    field_matrix(ray(c, p.q[0], 0), at_first);
    for (int64_t s = 0; s < c.n_sensors; ++s) {
      T f[3][3], *const kept = by_moment_ + 9 * s;
      rays_[s] = ray(c, p.q[0], s);
      field_matrix(rays_[s], f);
      const double w = c.weight(s);
      for (int i = 0; i < 3; ++i)
        for (int j = 0; j <= i; ++j) {
          f[i][j] = f[j][i] = w * (f[i][j] - at_first[i][j]);
          kept[3 * i + j] = f[i][j];
          sum[i][j] += w * f[i][j];
        }
      for (int i = 0; i < 3; ++i) {
        for (int j = 0; j <= i; ++j) square[i][j] += dot(f[i], f[j]);
        product[i] += f[i][0] * c.y[3 * s] + f[i][1] * c.y[3 * s + 1] + f[i][2] * c.y[3 * s + 2];
      }
    }
    const double inverse_sum = c.inverse_sum();
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < i; ++j) sum[j][i] = sum[i][j];
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j <= i; ++j) square[i][j] -= inverse_sum * dot(sum[i], sum[j]);
    const T no_ridge[3] = {};
    const Ldl<T, 3> moments(square, T{}, no_ridge, 1e-13);
    moments.solve(product, p.mu[0]);
    T common[3];
    for (int a = 0; a < 3; ++a) common[a] = -inverse_sum * dot(sum[a], mu);

    T t[3][4], sum_jacobian[3][3] = {}, cross[3][3] = {}, information[3][3] = {}, gradient[3] = {}, chi2 = {};
    fill_tangents(p.q[0], rules.free, t);
    for (int64_t s = 0; s < c.n_sensors; ++s) {
      T f[3][3], jacobian[3][3], rest[3];
      fill_derivatives(rays_[s], mu, t, c.sensors + 3 * s, jacobian);
      const double w = c.weight(s);
      for (int i = 0; i < 3; ++i)
        for (int j = 0; j <= i; ++j) f[i][j] = f[j][i] = by_moment_[9 * s + 3 * i + j];
      for (int a = 0; a < 3; ++a) {
        rest[a] = c.y[3 * s + a] - dot(f[a], mu) - w * common[a];
        chi2 += rest[a] * rest[a];
        for (int j = 0; j < 3; ++j) jacobian[a][j] *= w;
      }
      for (int a = 0; a < 3; ++a)
        for (int j = 0; j < 3; ++j) {
          sum_jacobian[a][j] += w * jacobian[a][j];
          gradient[j] += jacobian[a][j] * rest[a];
          for (int k = 0; k <= j; ++k) information[j][k] += jacobian[a][j] * jacobian[a][k];
          for (int k = 0; k < 3; ++k) cross[j][k] += f[k][a] * jacobian[a][j];
        }
    }
    p.chi2 = chi2;
    p.gain_by_moments = T{};
    for (int j = 0; j < 3; ++j) {
      p.gradient[j] = gradient[j];
      for (int k = 0; k < 3; ++k)
        for (int a = 0; a < 3; ++a) cross[j][k] -= inverse_sum * sum[k][a] * sum_jacobian[a][j];
    }
    for (int j = 0; j < 3; ++j) {
      T along[3];
      moments.solve(cross[j], along);
      for (int k = 0; k <= j; ++k) {
        p.information[j][k] = information[j][k] - dot(along, cross[k]);
        for (int a = 0; a < 3; ++a) p.information[j][k] -= inverse_sum * sum_jacobian[a][j] * sum_jacobian[a][k];
      }
    }
  }

  // The trial state after a step of half a radian at most for each source; by how much it promises to lower chi-square.
  static T move(const State<T, K> &at, T (&step)[D], const Rules &rules, State<T, K> &trial) {
    T longest = {};
    for (int k = 0; k < K; ++k) {
      const T(&x)[3] = reinterpret_cast<const T(&)[3]>(step[3 * k]);
      longest = maximum(longest, dot(x, x));
    }
    const auto too_long = longest > longest_step * longest_step;
    const T share = choose(too_long, longest_step / square_root(longest), broadcast<T>(1.0));
    for (int j = 0; j < D; ++j) step[j] *= share;
    T promised = at.gain_by_moments;
    for (int j = 0; j < D; ++j) {
      T curvature = {};
      for (int k = 0; k < D; ++k) curvature += at.information[j > k ? j : k][j > k ? k : j] * step[k];
      promised += step[j] * (2.0 * at.gradient[j] - curvature);
    }
    for (int k = 0; k < K; ++k) {
      const uint8_t *free = rules.free ? rules.free + 3 * k : nullptr;
      const bool range_is_free = !free || free[2];
      T t[3][4], moved[4];
      fill_tangents(at.q[k], free, t);
      for (int d = 0; d < 4; ++d) {
        moved[d] = at.q[k][d];
        for (int j = 0; j < 3; ++j) moved[d] += step[3 * k + j] * t[j][d];
      }
      // Back to the sphere: all of q, or at one range u alone.
      const T square = moved[0] * moved[0] + moved[1] * moved[1] + moved[2] * moved[2];
      const T square_s = moved[3] * moved[3];
      const T scale = 1.0 / square_root(range_is_free ? square + square_s : square / (1.0 - square_s));
      const T s = range_is_free ? scale * moved[3] : moved[3];
      const T sign = choose(s >= 0.0, broadcast<T>(1.0), broadcast<T>(-1.0));
      for (int a = 0; a < 3; ++a) trial.q[k][a] = scale * moved[a];
      trial.q[k][3] = choose(sign * s >= smallest_s, s, sign * smallest_s);
      for (int a = 0; a < 3; ++a) trial.mu[k][a] = at.mu[k][a];
    }
    return promised;
  }
};
MAGLOC_END
