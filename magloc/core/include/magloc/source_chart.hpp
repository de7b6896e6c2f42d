// Coordinates in which a tracked source is Gaussian: log-range, direction, the moment as it is seen and, where there
// are any, the velocity and further numbers. magloc/tracking/coordinates.py explains them and is the reference.
#pragma once
#include "elementary.hpp"
#include "linear.hpp"

MAGLOC_BEGIN
// Directions at right angles to the chart's own lie at infinity: they are taken as this near to it.
constexpr double least_cosine = 0.05;
constexpr int64_t n_measured = 6,
                  max_source_states = 12;  // position and moment, which readings depend on; numbers of a source

// A state, and how it changes with its coordinates: dx = (position da, power m da_0 + moment da, v da_0 + reach da,
// da).
struct ChartedState {
  double x[max_source_states], position[3][3], moment[3][3], reach;
};

// Coordinates about a state.
class SourceChart {
  const double *x_;
  int64_t n_, power_;  // length of the state; power of the range with which the moment grows, 0 or 4
  double tangent_[2][3], direction_[3], length_, unit_, strength_;  // unit_: length^power
  bool firm_ = false;  // whether strength and direction of the moment are coordinates

  double to_power(double x) const { return power_ == 4 ? (x * x) * (x * x) : 1.0; }

 public:
  // The chart about a state of n numbers, which must not go away, as seen from the sensors' centroid.
  SourceChart(const double *x, int64_t n, int64_t power, const double (&centroid)[3], double radius)
      : x_(x), n_(n), power_(power) {
    double offset[3];
    for (int i = 0; i < 3; ++i) offset[i] = x[i] - centroid[i];
    const double range = square_root(dot(offset, offset));
    for (int i = 0; i < 3; ++i) direction_[i] = range > 0.0 ? offset[i] / range : i == 2;
    fill_tangents(direction_, tangent_[0], tangent_[1]);
    length_ = maximum(range, radius);
    unit_ = to_power(length_);
    strength_ = square_root(x[3] * x[3] + x[4] * x[4] + x[5] * x[5]);
  }

  double strength() const { return strength_; }

  // Take strength and direction of the moment as coordinates if its variance, in this chart, leaves less than a share
  // of it open.
  void judge_moment(double variance, double share) { firm_ = square_root(variance) * unit_ < share * strength_; }

  // The state at coordinates e.
  void move(const double *e, ChartedState &there) const {
    const double growth = exponential(e[0]);
    double u[3];
    for (int i = 0; i < 3; ++i) u[i] = direction_[i] + tangent_[0][i] * e[1] + tangent_[1][i] * e[2];
    const double inverse = inverse_root(dot(u, u));
    for (double &component : u) component *= inverse;
    there.reach = growth * length_;
    for (int i = 0; i < 3; ++i) {
      there.x[i] = x_[i] + length_ * (growth * u[i] - direction_[i]);
      there.position[i][0] = there.reach * u[i];
      for (int a = 0; a < 2; ++a)
        there.position[i][1 + a] = there.reach * inverse * (tangent_[a][i] - u[i] * dot(u, tangent_[a]));
    }
    move_moment(e + 3, to_power(growth), there);
    for (int64_t i = n_measured; i < n_; ++i) there.x[i] = i < 9 ? growth * (x_[i] + length_ * e[i]) : x_[i] + e[i];
  }

  // The coordinates of a state: the inverse of `move`.
  void fill_coordinates(const double *state, double *e) const {
    double offset[3];
    for (int i = 0; i < 3; ++i) offset[i] = state[i] - x_[i] + length_ * direction_[i];
    const double range = square_root(dot(offset, offset)), growth = range / length_;
    const double cosine = maximum(dot(offset, direction_) / range, least_cosine);
    e[0] = logarithm(growth);
    for (int a = 0; a < 2; ++a) e[1 + a] = dot(offset, tangent_[a]) / (range * cosine);
    for (int64_t i = 3; i < n_; ++i) {
      const double rest = state[i] / (i < n_measured ? to_power(growth) : i < 9 ? growth : 1.0) - x_[i];
      e[i] = rest / (i < n_measured ? unit_ : i < 9 ? length_ : 1.0);
    }
    if (firm_) fill_turn(state + 3, to_power(growth), e + 3);
  }

  // Turn small changes of the coordinates into those of the state, in place: rows of `width` registers for position and
  // moment and, unless it is null, for the further numbers.
  template <class T>
  void to_state(const ChartedState &there, T *seen, T *further, int64_t width) const {
    for (int64_t j = 0; j < width; ++j) {
      const T e[3] = {seen[j], seen[width + j], seen[2 * width + j]};
      const T n[3] = {seen[3 * width + j], seen[4 * width + j], seen[5 * width + j]};
      for (int i = 0; i < 3; ++i) {
        seen[i * width + j] = dot(there.position[i], e);
        seen[(3 + i) * width + j] = dot(there.moment[i], n) + (double)power_ * there.x[3 + i] * e[0];
        if (further && n_ > n_measured) {
          T &entry = further[i * width + j];
          entry = there.reach * entry + there.x[6 + i] * e[0];
        }
      }
    }
  }
  // And small changes of the state into those of its coordinates.
  template <class T>
  void to_coordinates(T *seen, T *further, int64_t width) const {
    const double inverse = 1.0 / length_, per_unit = 1.0 / unit_;
    for (int64_t j = 0; j < width; ++j) {
      const T d[3] = {inverse * seen[j], inverse * seen[width + j], inverse * seen[2 * width + j]};
      const T along = dot(direction_, d);
      seen[j] = along;
      for (int a = 0; a < 2; ++a) seen[(1 + a) * width + j] = dot(tangent_[a], d);
      for (int i = 0; i < 3; ++i) {
        T &moment = seen[(3 + i) * width + j];
        moment = per_unit * (moment - (double)power_ * x_[3 + i] * along);
        if (further && n_ > n_measured) {
          T &entry = further[i * width + j];
          entry = inverse * (entry - x_[6 + i] * along);
        }
      }
    }
  }

 private:
  // The coordinates of a firm moment, seen from where the range has grown by the scale.
  void fill_turn(const double *moment, double scale, double *e) const {
    const double size = square_root(moment[0] * moment[0] + moment[1] * moment[1] + moment[2] * moment[2]);
    const double product = moment[0] * x_[3] + moment[1] * x_[4] + moment[2] * x_[5];
    const double cosine = maximum(product / (size * strength_), least_cosine);
    const double stretch = logarithm(size / (scale * strength_));
    for (int i = 0; i < 3; ++i) {
      const double along = x_[3 + i] / strength_, across = moment[i] / (size * cosine) - along;
      e[i] = strength_ / unit_ * (across + stretch * along);
    }
  }
  // `scale`: the power of the growth of the range.
  void move_moment(const double *e, double scale, ChartedState &there) const {
    if (!firm_) {
      for (int i = 0; i < 3; ++i) {
        there.x[3 + i] = scale * (x_[3 + i] + unit_ * e[i]);
        for (int j = 0; j < 3; ++j) there.moment[i][j] = i == j ? scale * unit_ : 0.0;
      }
      return;
    }
    double before[3], change[3], b[3];  // directions of the moment before and after; the change in units of its size
    for (int i = 0; i < 3; ++i) before[i] = x_[3 + i] / strength_, change[i] = unit_ * e[i] / strength_;
    const double stretch = dot(before, change);
    for (int i = 0; i < 3; ++i) b[i] = before[i] * (1.0 - stretch) + change[i];
    const double inverse = inverse_root(dot(b, b)), size = scale * strength_ * exponential(stretch);
    for (double &component : b) component *= inverse;
    const double along = dot(b, before);
    for (int i = 0; i < 3; ++i) {
      there.x[3 + i] = size * b[i];
      for (int j = 0; j < 3; ++j) {
        const double projected = (i == j) - before[i] * before[j] - b[i] * b[j] + along * b[i] * before[j];
        there.moment[i][j] = size * unit_ / strength_ * (b[i] * before[j] + inverse * projected);
      }
    }
  }
};
MAGLOC_END
