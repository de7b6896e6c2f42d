// The profile of chi-square over the range of one source, and the set of ranges that it allows.
#pragma once
#include "elementary.hpp"
#include "refine.hpp"

MAGLOC_BEGIN
// Search for the angle at which the profile of chi-square has risen by so much, inward (angles rise) or outward. The
// angle alpha = atan2(s, |u|) of the range is pi/2 at the centroid, 0 at infinity, and negative beyond it.
struct ProfileEnd {
  // Chi-square is read to so much; a longer step would leap over what is between.
  static constexpr double same_rise = 0.01, longest_step = 0.2, right_angle = 1.5707963267948966;

  double optimum, chi2, rise, toward;  // where it begins, the rise that is wanted, and +1 or -1
  double tried, last_step;
  double inside, f_inside;                // last angle within the rise, and chi-square there above the wanted one
  double outside = nan, f_outside = nan;  // the same beyond it
  double direction[3];                    // of u, at s > 0
  int64_t fit;
  double *out;  // where the end goes

  void begin(const magloc_source_uncertainty &p, int64_t k, double side, double wanted, double step) {
    const double *q = p.q + 4 * k, sign = q[3] < 0.0 ? -1.0 : 1.0;
    const double length = square_root(q[0] * q[0] + q[1] * q[1] + q[2] * q[2]);
    for (int a = 0; a < 3; ++a) direction[a] = sign * q[a] / length;
    optimum = inside = arc_tangent(__builtin_fabs(q[3]), length);
    chi2 = p.chi2[k], rise = wanted, f_inside = -wanted;
    toward = side, fit = k, last_step = step, outside = f_outside = nan;
    tried = bounded(optimum + toward * last_step);
  }

  // Coordinates at the angle to be tried, but not at infinity.
  void place(double *q) const {
    double sine, cosine, angle = tried;
    if (__builtin_fabs(angle) < smallest_s) angle = angle < 0.0 ? -smallest_s : smallest_s;
    fill_sine_and_cosine(angle, sine, cosine);
    for (int a = 0; a < 3; ++a) q[a] = cosine * direction[a];
    q[3] = sine;
  }

  // Take the chi-square at the angle that was tried, and the q to which the next step there leads; return whether the
  // search ends, at `tried`. The square root of the profile is nearly linear: it is inter- and extrapolated, guarded by
  // bisection. The end is +-pi/2 where chi-square never rises so much.
  bool take(double chi2_there, const double *q) {
    const double f = chi2_there - chi2 - rise;
    const bool within = !(f > 0.0);
    if (__builtin_fabs(f) < same_rise) return true;
    if (within)
      inside = tried, f_inside = maximum(f, -rise);
    else
      outside = tried, f_outside = f;
    if (!(outside == outside)) {
      if (tried == toward * (right_angle - smallest_s)) return tried = toward * right_angle, true;
      const double reached = __builtin_fabs(tried - optimum), risen = maximum(f + rise, 1e-3 * rise);
      double step = maximum(1.05 * reached * (square_root(rise / risen) - 1.0), 0.1 * last_step);
      step = minimum(step, 1.7 * last_step);
      last_step = minimum(step, longest_step);
      tried = bounded(inside + toward * last_step);
    } else {
      const double near = __builtin_fabs(inside), far = __builtin_fabs(outside);
      if (__builtin_fabs(outside - inside) < 1e-4 * minimum(near, far)) return true;
      const double a = square_root(maximum(f_inside + rise, 0.0)), b = square_root(f_outside + rise);
      const double share = b > a ? (square_root(rise) - a) / (b - a) : 0.5;
      tried = inside + (share < 0.05 ? 0.05 : share > 0.95 ? 0.95 : share) * (outside - inside);
    }
    if (within) {
      const double length = square_root(1.0 - q[3] * q[3]);
      for (int a = 0; a < 3; ++a) direction[a] = q[a] / length;
    }
    return false;
  }

 private:
  double bounded(double angle) const {
    const double bound = toward * (right_angle - smallest_s);
    return toward * (angle - bound) > 0.0 ? bound : angle;
  }
};

// Profiles of chi-square over the range. All ends that are searched for take one step, then they are refined together.
template <class T, class Channels>
class RangeProfiles {
  // Gain of Gauss-Newton at which a point is one of the profile; steps until a search is given up.
  static constexpr double tolerance = 1e-2;
  static constexpr int64_t max_iterations = 30, most_steps = 100;
  static constexpr uint8_t free_[3] = {1, 1, 0};

  Channels channels_;
  Refinement<T, 1> refinement_;
  const magloc_source_uncertainty &p_;
  ProfileEnd *const searches_;
  ProfileEnd **const live_;
  int64_t *const row_, *const iterations_;
  double *const start_, *const q_, *const mu_, *const chi2_;
  uint8_t *const converged_;

 public:
  RangeProfiles(const magloc_source_uncertainty &p, int64_t n_fits, Workspace &room)
      : channels_(*p.channels, p.signals, room),
        refinement_(channels_, room),
        p_(p),
        searches_(room.take<ProfileEnd>(2 * n_fits)),
        live_(room.take<ProfileEnd *>(2 * n_fits)),
        row_(room.take<int64_t>(2 * n_fits)),
        iterations_(room.take<int64_t>(2 * n_fits)),
        start_(room.take<double>(8 * n_fits)),
        q_(room.take<double>(8 * n_fits)),
        mu_(room.take<double>(6 * n_fits)),
        chi2_(room.take<double>(2 * n_fits)),
        converged_(room.take<uint8_t>(2 * n_fits)) {}

  // Angles (n, 2) of fits within rises (n,), NaN where that is not positive or infinite; first steps are (n,).
  void run(int64_t first_fit, int64_t n, const double *rise, const double *step, double *angles) {
    for (int64_t i = 0; i < 2 * n; ++i) angles[i] = nan;
    run_those(first_fit, n, rise, step, angles, true);
    run_those(first_fit, n, rise, step, angles, false);
  }

 private:
  // Only the fits for which few digits do, or only the others.
  void run_those(int64_t first_fit, int64_t n_fits, const double *rise, const double *step, double *angles,
                 bool few_digits) {
    int64_t n = 0;
    for (int64_t i = 0; i < n_fits; ++i) {
      if (!(rise[i] > 0.0 && rise[i] < infinity)) continue;
      if (channels_.few_digits_do(p_.row[first_fit + i]) != few_digits) continue;
      for (int side = 0; side < 2; ++side, ++n) {
        searches_[n].begin(p_, first_fit + i, side ? 1.0 : -1.0, rise[i], step[i]);
        searches_[n].out = angles + 2 * i + side;
        live_[n] = &searches_[n];
      }
    }
    for (int64_t i = 0; i < most_steps && n > 0; ++i) n = advance(n, few_digits);
    for (int64_t i = 0; i < n; ++i) *live_[i]->out = live_[i]->inside;
  }

  // Let n searches take a step; return how many go on.
  int64_t advance(int64_t n, bool few_digits) {
    for (int64_t i = 0; i < n; ++i) {
      row_[i] = p_.row[live_[i]->fit];
      live_[i]->place(start_ + 4 * i);
    }
    const Rules rules{tolerance, 0.0, max_iterations, true, few_digits, free_};
    refinement_.run(channels_, {n, row_, start_, nullptr, nullptr}, rules, {q_, mu_, chi2_, iterations_, converged_});
    int64_t n_left = 0;
    for (int64_t i = 0; i < n; ++i)
      if (live_[i]->take(chi2_[i], q_ + 4 * i))
        *live_[i]->out = live_[i]->tried;
      else
        live_[n_left++] = live_[i];
    return n_left;
  }
};

// Disjoint ascending ranges (most, 2) in radii; NaN behind them.
struct Ranges {
  double *const ends;
  const int64_t most;
  int64_t count;

  // Ranges that the angles of n fits cover; a stretch through infinity has two sides.
  void unite(const double *angles, int64_t n) {
    count = 0;
    for (int64_t k = 0; k < n; ++k) {
      const double first = angles[2 * k], last = angles[2 * k + 1], nearest = maximum(last, -first);
      if (!(first <= last)) continue;
      const double low = cotangent(nearest), high = first > 0.0 ? cotangent(first) : infinity;
      int64_t place = count++;
      for (; place > 0 && ends[2 * place - 2] > low; --place)
        ends[2 * place] = ends[2 * place - 2], ends[2 * place + 1] = ends[2 * place - 1];
      ends[2 * place] = low, ends[2 * place + 1] = high;
    }
    const int64_t n_sorted = count;
    count = 0;
    for (int64_t k = 0; k < n_sorted; ++k) {
      const double low = ends[2 * k], high = ends[2 * k + 1];
      if (count > 0 && low <= ends[2 * count - 1])
        ends[2 * count - 1] = maximum(ends[2 * count - 1], high);
      else
        ends[2 * count] = low, ends[2 * count + 1] = high, ++count;
    }
    for (int64_t i = 2 * count; i < 2 * most; ++i) ends[i] = nan;
  }

 private:
  static double cotangent(double angle) {
    double sine, cosine;
    if (angle >= ProfileEnd::right_angle) return 0.0;
    fill_sine_and_cosine(angle, sine, cosine);
    return cosine / sine;
  }
};
MAGLOC_END
