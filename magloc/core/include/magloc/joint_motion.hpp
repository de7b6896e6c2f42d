// How several sources move that one filter follows together, and the chart in which the errors of their moments are
// Gaussian: magloc/tracking/multi_target/{state,motion}.py.
#pragma once
#include "elementary.hpp"
#include "padded.hpp"

MAGLOC_BEGIN
typedef double Block[3][3];

// Numbers of a source that a row of readings sees, of its motion, and of the common field.
constexpr int64_t n_seen = 6, n_motion = 6, n_common = 3;
constexpr int64_t seen_numbers(int64_t n_sources) { return n_seen * n_sources + n_common; }
constexpr int64_t all_numbers(int64_t n_sources) { return (n_seen + n_motion) * n_sources + n_common; }

// Means of all sources, (n_sources, 3) each, and the common field.
struct JointMeans {
  double *position, *moment, *velocity, *rate, *common;

  static JointMeans of(const magloc_joint_state &state, int64_t row = 0) {
    const int64_t at = 3 * state.n_sources * row;
    return {state.position + at, state.moment + at, state.velocity + at, state.rate + at, state.common + 3 * row};
  }
  static JointMeans in(Workspace &space, int64_t n_sources) {
    double *means[4];
    for (double *&one : means) one = space.take<double>(3 * n_sources);
    return {means[0], means[1], means[2], means[3], space.take<double>(3)};
  }
};

// Multiply a vector by the transpose of a block.
template <class T>
MAGLOC_INLINE void multiply_transposed(const Block &block, const T *v, T (&product)[3]) {
  for (int i = 0; i < 3; ++i) product[i] = block[0][i] * v[0] + block[1][i] * v[1] + block[2][i] * v[2];
}

inline double norm(const double *v) { return square_root(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]); }

// Moment at an error c in the chart about m, and its derivative by c: `moved_moment`, `moment_derivative`.
inline void move_moment(const double *m, const double *c, double *moved, Block &derivative) {
  const double length = norm(m), u[3] = {m[0] / length, m[1] / length, m[2] / length};
  const double along = u[0] * c[0] + u[1] * c[1] + u[2] * c[2];
  const double turn[3] = {c[0] - along * u[0], c[1] - along * u[1], c[2] - along * u[2]};
  const double square = dot(turn, turn), angle = square_root(square);
  double sine, cosine, sinc = 1.0 - square / 6.0, bend = square / 30.0 - 1.0 / 3.0;
  fill_sine_and_cosine_of_any(angle, sine, cosine);
  if (angle > 1e-2) {
    sinc = sine / angle;
    bend = (cosine - sinc) / square;
  }
  const double strength = length * exponential(along);
  for (int i = 0; i < 3; ++i) {
    const double direction = cosine * u[i] + sinc * turn[i];
    moved[i] = strength * direction;
    for (int j = 0; j < 3; ++j) {
      // By the turn, which has no part along u; that the angle grows with it bends the path.
      const double by_turn = (i == j ? sinc : 0.0) - (sinc * u[i] - bend * turn[i]) * turn[j] - sinc * u[i] * u[j];
      derivative[i][j] = strength * (direction * u[j] + by_turn);
    }
  }
}

// Error c in the chart about a moment m that leads to another one, and how small errors about the other one follow from
// small changes of c.
inline void fill_chart(const double *m, const double *other, double *c, Block &change) {
  const double length = norm(m), size = norm(other);
  const double cosine = (m[0] * other[0] + m[1] * other[1] + m[2] * other[2]) / (length * size);
  for (int i = 0; i < 3; ++i) c[i] = other[i] / size - cosine * m[i] / length;
  const double sine = norm(c), per_sine = sine > 0.0 ? arc_tangent(sine, cosine) / sine : 1.0;
  const double strength = logarithm(size / length);
  for (int i = 0; i < 3; ++i) c[i] = per_sine * c[i] + strength * m[i] / length;
  double moved[3];
  move_moment(m, c, moved, change);
  for (auto &row : change)
    for (double &x : row) x /= size;
}

// Multiply three rows of a matrix by a block, and the same columns by its transpose.
template <class T>
void change_chart(const Padded<T> &covariance, int64_t n, int64_t at, const Block &block) {
  for (int64_t j = 0; j < covariance.width(); ++j) {
    const T old[3] = {covariance.lanes(at)[j], covariance.lanes(at + 1)[j], covariance.lanes(at + 2)[j]};
    for (int i = 0; i < 3; ++i) covariance.lanes(at + i)[j] = dot(block[i], old);
  }
  for (int64_t j = 0; j < n; ++j) {
    double *row = covariance[j] + at;
    const double old[3] = {row[0], row[1], row[2]};
    for (int i = 0; i < 3; ++i) row[i] = dot(block[i], old);
  }
}

// A step of `FreeMotion`, in the order of its `numbers`.
struct JointStep {
  double velocity_lasts, velocity_kept, rate_lasts, rate_kept;
  double position_noise, position_velocity_noise, velocity_noise, turn_noise, turn_rate_noise, rate_noise;
  double strength_noise, common_noise;

  explicit JointStep(const double *numbers) { __builtin_memcpy(this, numbers, sizeof *this); }
};

// How a source's moment turns in a step: the rotation, what errors of the rate of turn add to those of the direction,
// and the direction after it.
struct Turn {
  Block rotation, by_rate;
  double direction[3];
};

// Turn a moment in place by a rate.
inline void turn_moment(double *moment, const double *rate, double rate_lasts, Turn &turn) {
  const double angle[3] = {rate_lasts * rate[0], rate_lasts * rate[1], rate_lasts * rate[2]};
  Block turns;
  fill_rotation(angle, turn.rotation, turns);
  const double before[3] = {moment[0], moment[1], moment[2]};
  for (int i = 0; i < 3; ++i) moment[i] = dot(turn.rotation[i], before);
  const double length = norm(moment);
  for (int i = 0; i < 3; ++i) turn.direction[i] = moment[i] / length;
  for (int j = 0; j < 3; ++j) {
    double changed[3];
    cross(turns[j], turn.direction, changed);
    for (int i = 0; i < 3; ++i) turn.by_rate[i][j] = rate_lasts * changed[i];
  }
}

// Fill the means after a step, and how the moments turn.
inline void step_means(const JointMeans &before, int64_t n_sources, const JointStep &step, const JointMeans &after,
                       Turn *turns) {
  for (int64_t i = 0; i < 3 * n_sources; ++i) {
    after.position[i] = before.position[i] + step.velocity_lasts * before.velocity[i];
    after.moment[i] = before.moment[i];
    after.velocity[i] = step.velocity_kept * before.velocity[i];
    after.rate[i] = step.rate_kept * before.rate[i];
  }
  for (int i = 0; i < n_common; ++i) after.common[i] = before.common[i];
  for (int64_t k = 0; k < n_sources; ++k)
    turn_moment(after.moment + 3 * k, before.rate + 3 * k, step.rate_lasts, turns[k]);
}

// Multiply the rows of each source by its transition: errors of position and moment, and of velocity and rate.
template <class T>
void transition_rows(T *rows, int64_t width, int64_t n_sources, const JointStep &step, const Turn *turns) {
  for (int64_t k = 0; k < n_sources; ++k) {
    T *seen = rows + n_seen * k * width, *motion = rows + (seen_numbers(n_sources) + n_motion * k) * width;
    for (int64_t j = 0; j < width; ++j, ++seen, ++motion) {
      T moment[3], rate[3];
      for (int i = 0; i < 3; ++i) {
        moment[i] = seen[(3 + i) * width];
        rate[i] = motion[(3 + i) * width];
      }
      for (int i = 0; i < 3; ++i) {
        seen[i * width] += step.velocity_lasts * motion[i * width];
        seen[(3 + i) * width] = dot(turns[k].rotation[i], moment) + dot(turns[k].by_rate[i], rate);
        motion[i * width] *= step.velocity_kept;
        motion[(3 + i) * width] *= step.rate_kept;
      }
    }
  }
}

// Replace a covariance P by F P F^T + Q, source by source, as no source moves another.
template <class T>
void step_covariance(const Padded<T> &covariance, int64_t n_sources, const JointStep &step, const Turn *turns) {
  const int64_t n = all_numbers(n_sources), seen = seen_numbers(n_sources);
  transition_rows(covariance.lanes(0), covariance.width(), n_sources, step, turns);
  transpose(covariance, n);
  transition_rows(covariance.lanes(0), covariance.width(), n_sources, step, turns);
  for (int64_t k = 0; k < n_sources; ++k) {
    const int64_t at = n_seen * k, motion = seen + n_motion * k;
    const double (&u)[3] = turns[k].direction;
    // What a small turn changes of the direction
    const Block turned = {{0.0, u[2], -u[1]}, {-u[2], 0.0, u[0]}, {u[1], -u[0], 0.0}};
    for (int i = 0; i < 3; ++i) {
      covariance[at + i][at + i] += step.position_noise;
      covariance[at + i][motion + i] += step.position_velocity_noise;
      covariance[motion + i][at + i] += step.position_velocity_noise;
      covariance[motion + i][motion + i] += step.velocity_noise;
      covariance[motion + 3 + i][motion + 3 + i] += step.rate_noise;
      for (int j = 0; j < 3; ++j) {
        const double along = u[i] * u[j], across = (i == j) - along;
        covariance[at + 3 + i][at + 3 + j] += step.turn_noise * across + step.strength_noise * along;
        covariance[at + 3 + i][motion + 3 + j] += step.turn_rate_noise * turned[i][j];
        covariance[motion + 3 + j][at + 3 + i] += step.turn_rate_noise * turned[i][j];
      }
    }
  }
  for (int64_t i = seen - n_common; i < seen; ++i) covariance[i][i] += step.common_noise;
}
MAGLOC_END
