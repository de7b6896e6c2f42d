// How a source moves between rows of readings.
#pragma once
#include "elementary.hpp"
#include "kernel.hpp"
#include "source_chart.hpp"

MAGLOC_BEGIN
// A step of a source that turns: rate of turn and velocity are forgotten, as magloc.tracking.motion.OrnsteinUhlenbeck.
struct TurningStep {
  double velocity_lasts, velocity_kept, rate_lasts, rate_kept;
  double velocity[3], rate[3];  // lower roots (00, 10, 11) of the noise of (position, velocity), and of (turn, rate)
  double across, along;         // noise of the moment, relative to its modulus
};

class SourceMotion {
  const magloc_motion &p_;
  const int64_t n_, n_nuisances_;
  double F_[max_source_states * max_source_states];
  double *const noise_;  // (n, n_noise)

 public:
  double x[max_source_states] = {};  // the state after the step
  const double *F = nullptr;         // (n, n) its derivative by the state before
  const double *noise = nullptr;     // (n, n_noise) root of its noise
  const int64_t n_noise;

  SourceMotion(const magloc_motion &p, int64_t n_states, int64_t n_nuisances, Workspace &space)
      : p_(p),
        n_(n_states),
        n_nuisances_(n_nuisances),
        noise_(space.take<double>(n_states * p.n_noise)),
        n_noise(p.n_noise) {}

  // Nuisances are constant unless they have noise.
  bool has_noisy_nuisances() const { return p_.added; }
  const double *kept(int64_t step) const { return p_.kept + n_nuisances_ * step; }
  const double *added(int64_t step) const { return p_.added + n_nuisances_ * step; }

  // Take the step of a state; `source` counts all sources of all states.
  void take(const double *before, int64_t step, int64_t source) {
    if (p_.turning) {
      TurningStep turning;
      __builtin_memcpy(&turning, p_.turning + 12 * step, sizeof turning);
      turn(before, turning);
      return;
    }
    const int64_t at = p_.moved ? source : step;
    const double strength = square_root(before[3] * before[3] + before[4] * before[4] + before[5] * before[5]);
    F = p_.F + n_ * n_ * at;
    for (int64_t i = 0; i < n_; ++i) {
      x[i] = p_.moved ? p_.moved[n_ * at + i] : 0.0;
      if (!p_.moved)
        for (int64_t j = 0; j < n_; ++j) x[i] += F[n_ * i + j] * before[j];
    }
    noise = p_.A + n_ * n_noise * at;
    if (!p_.B) return;
    for (int64_t i = 0; i < n_ * n_noise; ++i) noise_[i] = noise[i] + strength * p_.B[n_ * n_noise * at + i];
    noise = noise_;
  }

 private:
  void turn(const double *before, const TurningStep &step) {
    F = F_, noise = noise_;
    __builtin_memset(F_, 0, sizeof F_);
    __builtin_memset(noise_, 0, n_ * n_noise * sizeof(double));
    double angle[3];
    for (int i = 0; i < 3; ++i) {
      x[i] = before[i] + step.velocity_lasts * before[6 + i];
      x[6 + i] = step.velocity_kept * before[6 + i];
      x[9 + i] = step.rate_kept * before[9 + i];
      angle[i] = step.rate_lasts * before[9 + i];
    }
    double rotation[3][3], turns[3][3];
    fill_rotation(angle, rotation, turns);
    const double moment[3] = {before[3], before[4], before[5]};
    for (int i = 0; i < 3; ++i) {
      x[3 + i] = dot(rotation[i], moment);
      for (int j = 0; j < 3; ++j) F_[12 * (3 + i) + 3 + j] = rotation[i][j];
    }
    const double m[3] = {x[3], x[4], x[5]}, strength = square_root(dot(m, m));
    for (int j = 0; j < 3; ++j) {
      double by_rate[3];
      cross(turns[j], m, by_rate);
      for (int i = 0; i < 3; ++i) {
        const double along = strength > 0.0 ? m[i] * m[j] / strength : 0.0;
        F_[12 * (3 + i) + 9 + j] = step.rate_lasts * by_rate[i];
        noise_[15 * (3 + i) + 3 + j] = step.rate[0] * by_rate[i];
        noise_[15 * (3 + i) + 12 + j] = step.across * ((i == j) * strength - along) + step.along * along;
      }
      F_[13 * j] = 1.0, F_[12 * j + 6 + j] = step.velocity_lasts;
      F_[13 * (6 + j)] = step.velocity_kept, F_[13 * (9 + j)] = step.rate_kept;
      noise_[16 * j] = step.velocity[0];
      noise_[15 * (6 + j) + j] = step.velocity[1], noise_[15 * (6 + j) + 6 + j] = step.velocity[2];
      noise_[15 * (9 + j) + 3 + j] = step.rate[1], noise_[15 * (9 + j) + 9 + j] = step.rate[2];
    }
  }
};
MAGLOC_END
