// Guaranteed ellipsoids of many runs. The readable reference, with the formulas, is
// tests/adcs/ellipsoids/readable.py.
#include "magloc/kernel.hpp"

MAGLOC_BEGIN
constexpr double eps = 2.220446049250313e-16, least_seen = 1e-12;
constexpr double smallest_half_width = 1e-3, smallest_growth = 1e-6, largest_step = 1.0 - 1e-9;
enum Rule { lemma, optimal, tightened };

// A strip |y - h x| <= c in units of the ellipsoid's half-width along h: its middle and its half-width.
struct Strip {
  double mu, delta;

  Strip narrowed() const {
    const double low = maximum(-1.0, mu - delta), high = minimum(1.0, mu + delta);
    return {0.5 * (low + high), maximum(0.5 * (high - low), smallest_half_width)};
  }

  // The step of least trace: the root of a cubic by Newton's method, in a bracket that is halved wherever a step would
  // leave it.
  double optimal_step(double g) const {
    const double mu2 = mu * mu, delta2 = delta * delta;
    const double a = 2.0 * g * mu2, b = g * (1.0 - delta2) + mu2 * (1.0 - 2.0 * g), c = delta2 * (1.0 - g);
    double low = 1.0 - largest_step, high = 1.0, s = 0.5;
    if (low * low * (b + a * low) - c >= 0.0) return largest_step;
    for (int i = 0; i < 200; ++i) {
      const double value = s * s * (b + a * s) - c, before = s;
      (value < 0.0 ? low : high) = s;
      s -= value / (s * (2.0 * b + 3.0 * a * s));
      if (!(low < s && s < high)) s = 0.5 * (low + high);
      if (__builtin_fabs(s - before) <= 1e-15 * s) break;
    }
    return 1.0 - s;
  }
};

class Ellipsoid {
  int64_t n_;
  double *x_, *H_, *Hh_, *M_;  // centre, shape; workspace: H h, and a matrix

  double half_width(int64_t i) const { return square_root(H_[i * n_ + i]); }
  double trace(const double *A) const {
    double sum = 0.0;
    for (int64_t i = 0; i < n_; ++i) sum += A[i * n_ + i];
    return sum;
  }
  // Enlarge the shape by what rounding of the centre, sums of terms up to a size, moves out of it.
  template <class Size>
  void cover_rounding(Size size) {
    for (int64_t i = 0; i < n_ * n_; ++i) M_[i] = 0.0;
    for (int64_t i = 0; i < n_; ++i) M_[i * n_ + i] = 16.0 * (double)n_ * eps * eps * size(i) * size(i);
    add(M_);
  }

 public:
  Ellipsoid(int64_t n, Workspace &room) : n_(n), Hh_(room.take<double>(n)), M_(room.take<double>(n * n)) {}
  void use(double *centre, double *shape) { x_ = centre, H_ = shape; }

  // Add the ellipsoid of shape Q: the result has the least trace.
  void add(const double *Q) {
    const double trace_H = trace(H_), trace_Q = trace(Q);
    if (trace_Q == 0.0) return;
    const double k = square_root(trace_Q) / square_root(trace_H);
    for (int64_t i = 0; i < n_ * n_; ++i) H_[i] = trace_H == 0.0 ? Q[i] : (1.0 + 1.0 / k) * Q[i] + (1.0 + k) * H_[i];
  }

  void predict(const double *A, const double *Q, const double *input, double *size, double *reach) {
    for (int64_t i = 0; i < n_; ++i) {
      double moved = input[i];
      size[i] = __builtin_fabs(input[i]), reach[i] = 0.0;
      for (int64_t j = 0; j < n_; ++j) {
        const double term = A[i * n_ + j] * x_[j];
        moved += term, size[i] += __builtin_fabs(term);
        reach[i] += __builtin_fabs(A[i * n_ + j]) * half_width(j);
        M_[i * n_ + j] = 0.0;
        for (int64_t k = 0; k < n_; ++k) M_[i * n_ + j] += A[i * n_ + k] * H_[k * n_ + j];
      }
      Hh_[i] = moved;
    }
    for (int64_t i = 0; i < n_; ++i) {
      x_[i] = Hh_[i];
      for (int64_t j = 0; j <= i; ++j) {
        double value = i == j ? 4.0 * (double)n_ * eps * reach[i] * reach[i] : 0.0;
        for (int64_t k = 0; k < n_; ++k) value += M_[i * n_ + k] * A[j * n_ + k];
        H_[i * n_ + j] = H_[j * n_ + i] = value;
      }
    }
    cover_rounding([&](int64_t i) { return size[i]; });
    add(Q);
  }

  double innovation(const double *h, double y) const {
    for (int64_t i = 0; i < n_; ++i) y -= h[i] * x_[i];
    return y;
  }

  // Cut the ellipsoid to a strip. Return false if they have no point in common.
  bool intersect(const double *h, double y, double c, Rule rule) {
    double e2 = 0.0, h2 = 0.0, square = 0.0, size = 0.0, reach = 0.0;
    for (int64_t i = 0; i < n_; ++i) {
      Hh_[i] = 0.0;
      for (int64_t j = 0; j < n_; ++j) Hh_[i] += H_[i * n_ + j] * h[j];
      e2 += h[i] * Hh_[i], h2 += h[i] * h[i], square += Hh_[i] * Hh_[i];
      size += __builtin_fabs(h[i] * x_[i]), reach += __builtin_fabs(h[i]) * half_width(i);
    }
    const double nu = innovation(h, y), e = square_root(maximum(e2, 0.0)), tr = trace(H_);
    const double rounding = 4.0 * (double)n_ * eps * reach * reach;
    c += 4.0 * eps * (__builtin_fabs(y) + size);
    if (__builtin_fabs(nu) > c + square_root(maximum(e2, 0.0) + rounding)) return false;
    if (e2 <= least_seen * tr * h2) return true;
    Strip strip = {nu / e, c / e};
    if (n_ == 1) {
      if (__builtin_fabs(strip.mu) + 1.0 <= strip.delta) return true;
      strip = strip.narrowed();
      const double far = __builtin_fabs(x_[0]) + half_width(0);
      H_[0] *= strip.delta * strip.delta;
      cover_rounding([&](int64_t) { return far; });
      x_[0] += strip.mu / e * Hh_[0];
      return true;
    }
    if (rule == tightened) strip = strip.narrowed();
    const double mu2 = strip.mu * strip.mu, delta2 = strip.delta * strip.delta;
    const double g = minimum(square / (e2 * tr), 1.0), margin = rounding / e2;
    if (mu2 + g <= delta2) return true;
    double step = rule == lemma ? minimum(1.0 - delta2 / (g + mu2), largest_step) : strip.optimal_step(g);
    step = minimum(step, 1.0 / (1.0 + 2.0 * margin));
    const double growth =
        maximum(1.0 + step * (delta2 / (1.0 - step * (1.0 + margin)) - mu2) + margin, smallest_growth);
    if (!(growth * (1.0 - step * g + margin) < 1.0)) return true;
    for (int64_t i = 0; i < n_; ++i)
      for (int64_t j = 0; j <= i; ++j) {
        const double before = i == j ? H_[i * n_ + j] * (1.0 + margin) : H_[i * n_ + j];
        H_[i * n_ + j] = H_[j * n_ + i] = growth * (before - step / e2 * Hh_[i] * Hh_[j]);
      }
    cover_rounding([&](int64_t i) { return __builtin_fabs(x_[i]); });
    for (int64_t i = 0; i < n_; ++i) x_[i] += step * (strip.mu / e) * Hh_[i];
    return true;
  }
};
MAGLOC_END

using namespace magloc;

MAGLOC_KERNEL(ellipsoids_predict, ellipsoids) {
  const int64_t n = problem->n_states;
  Workspace room(workspace);
  Ellipsoid ellipsoid(n, room);
  double *size = room.take<double>(n), *reach = room.take<double>(n);
  if (!workspace) return room.size();
  for (int64_t run = begin; run < end; ++run) {
    ellipsoid.use(problem->centres + run * n, problem->shapes + run * n * n);
    ellipsoid.predict(problem->A, problem->disturbance, problem->inputs + run * n, size, reach);
  }
  return 0;
}

MAGLOC_KERNEL(ellipsoids_correct, ellipsoids) {
  const auto &p = *problem;
  const int64_t n = p.n_states, m = p.n_channels;
  Workspace room(workspace);
  Ellipsoid ellipsoid(n, room);
  if (!workspace) return room.size();
  for (int64_t run = begin; run < end; ++run) {
    ellipsoid.use(p.centres + run * n, p.shapes + run * n * n);
    for (int64_t channel = 0; channel < m; ++channel) {
      const double *h = p.directions + channel * n, y = p.readings[run * m + channel];
      double &bound = p.bounds[run * m + channel];
      if (y != y || ellipsoid.intersect(h, y, bound, (Rule)p.rule)) continue;
      ellipsoid.add(p.reinflation);
      bound = maximum(__builtin_fabs(ellipsoid.innovation(h, y)), p.inflation * bound);
      ++p.resets[run];
      ellipsoid.intersect(h, y, bound, (Rule)p.rule);
    }
  }
  return 0;
}
