// Coordinates in which a tracked source is Gaussian: log-range, direction, the moment as it is seen and, where there is
// one, the velocity. magloc/tracking/chart/coordinates.py explains them and is the reference.
#pragma once
#include "elementary.hpp"
#include "numbers.hpp"

MAGLOC_BEGIN
// Coordinates about a state of n numbers: position, moment and, with n = 9, velocity.
template <int n>
class Chart {
  static_assert(n == 6 || n == 9, "position and moment, or velocity as well");
  double x_[n], tangent_[2][3], direction_[3], length_;
  double unit_;        // of moments: length^4
  bool firm_ = false;  // whether strength and direction of the moment are coordinates

 public:
  // The chart about a state, as seen from the sensors' centroid.
  static Chart at(const double (&x)[n], const double (&centroid)[3], double radius) {
    Chart chart;
    for (int i = 0; i < n; ++i) chart.x_[i] = x[i];
    double offset[3];
    for (int i = 0; i < 3; ++i) offset[i] = x[i] - centroid[i];
    const double range = square_root(dot(offset, offset));
    if (range == 0.0) offset[2] = 1.0;
    const double inverse = range == 0.0 ? 1.0 : 1.0 / range;
    for (int i = 0; i < 3; ++i) chart.direction_[i] = offset[i] * inverse;
    chart.length_ = maximum(range, radius);
    chart.unit_ = fourth_power(chart.length_);
    chart.fill_tangents();
    return chart;
  }

  // Take strength and direction of the moment as coordinates if the root of a covariance, in this chart, leaves less
  // than a share of the moment open.
  void judge_moment(const double (&root)[n][n], double share) {
    double variance = 0.0;
    for (int i = 3; i < 6; ++i)
      for (double s : root[i]) variance += s * s;
    firm_ = square_root(variance) * unit_ < share * strength();
  }

  // The modulus of the moment.
  double strength() const { return square_root(x_[3] * x_[3] + x_[4] * x_[4] + x_[5] * x_[5]); }

  // Fill the state at coordinates e, and its derivative by them.
  void move(const double (&e)[n], double (&there)[n], double (&derivative)[n][n]) const {
    const double growth = exponential(e[0]), reach = growth * length_;
    double u[3];
    for (int i = 0; i < 3; ++i) u[i] = direction_[i] + tangent_[0][i] * e[1] + tangent_[1][i] * e[2];
    const double inverse = inverse_root(dot(u, u));
    for (double &component : u) component *= inverse;
    const double along[2] = {dot(u, tangent_[0]), dot(u, tangent_[1])};
    __builtin_memset(derivative, 0, sizeof derivative);
    for (int i = 0; i < 3; ++i) {
      there[i] = x_[i] + length_ * (growth * u[i] - direction_[i]);
      derivative[i][0] = reach * u[i];
      for (int a = 0; a < 2; ++a) derivative[i][1 + a] = reach * inverse * (tangent_[a][i] - u[i] * along[a]);
    }
    move_moment(e, fourth_power(growth), there, derivative);
    if constexpr (n == 9)
      for (int i = 6; i < 9; ++i) {
        there[i] = growth * (x_[i] + length_ * e[i]);
        derivative[i][0] = there[i];
        derivative[i][i] = reach;
      }
  }

  // Turn small changes of the state, the columns of a matrix (n, n_columns), into those of its coordinates, in place.
  void to_coordinates(double *matrix, int64_t n_columns) const {
    for (int64_t c = 0; c < n_columns; ++c) {
      double change[3];
      for (int i = 0; i < 3; ++i) change[i] = matrix[i * n_columns + c] / length_;
      const double along = dot(direction_, change);
      matrix[c] = along;
      for (int a = 0; a < 2; ++a) matrix[(1 + a) * n_columns + c] = dot(tangent_[a], change);
      for (int i = 3; i < n; ++i) {
        double &entry = matrix[i * n_columns + c];
        entry = i < 6 ? (entry - 4.0 * x_[i] * along) / unit_ : (entry - x_[i] * along) / length_;
      }
    }
  }

 private:
  static double fourth_power(double x) { return (x * x) * (x * x); }

  // Duff et al., "Building an orthonormal basis, revisited".
  void fill_tangents() {
    const double x = direction_[0], y = direction_[1], z = direction_[2], sign = __builtin_copysign(1.0, z);
    const double a = -1.0 / (sign + z), b = x * y * a;
    const double tangents[2][3] = {{1.0 + sign * x * x * a, sign * b, -sign * x}, {b, sign + y * y * a, -y}};
    __builtin_memcpy(tangent_, tangents, sizeof tangents);
  }

  // The moment, and its derivatives. `scale` is the fourth power by which the range grows.
  void move_moment(const double (&e)[n], double scale, double (&there)[n], double (&derivative)[n][n]) const {
    if (firm_) {
      const double size = strength();
      double before[3], change[3], b[3];  // directions of the moment before and after; the change in units of its size
      for (int i = 0; i < 3; ++i) before[i] = x_[3 + i] / size, change[i] = unit_ * e[3 + i] / size;
      const double stretch = dot(before, change);
      for (int i = 0; i < 3; ++i) b[i] = before[i] * (1.0 - stretch) + change[i];
      const double inverse = inverse_root(dot(b, b)), new_size = scale * size * exponential(stretch);
      for (double &component : b) component *= inverse;
      const double along = dot(b, before);
      for (int i = 0; i < 3; ++i) {
        there[3 + i] = new_size * b[i];
        for (int j = 0; j < 3; ++j) {
          const double projected = (i == j) - before[i] * before[j] - b[i] * b[j] + along * b[i] * before[j];
          derivative[3 + i][3 + j] = new_size * unit_ / size * (b[i] * before[j] + inverse * projected);
        }
      }
    } else {
      for (int i = 3; i < 6; ++i) {
        there[i] = scale * (x_[i] + unit_ * e[i]);
        derivative[i][i] = scale * unit_;
      }
    }
    for (int i = 3; i < 6; ++i) derivative[i][0] = 4.0 * there[i];
  }
};
MAGLOC_END
