// Random updates of trackers: random_updates COUNT. Prints how many it made, how many were refused, and how many
// estimates were not finite. With QUICK all trackers have four sensors: each number takes seconds to compile.
#include <stdio.h>
#include <stdlib.h>

#include "magloc/tracker.hpp"
#include "random_readings.hpp"

template <int n>
void run(long count, long &refused, long &bad) {
  static magloc::Tracker<n> tracker;
  magloc::TrackerConfig<n> config = {};
  double time = 0.0, magnet[3] = {};
  for (long i = 0; i < count; ++i) {
    if (i % 1000 == 0) {
      for (auto &place : config.position_m)
        for (double &x : place) x = 0.1 * (2.0 * uniform() - 1.0);
      config.noise_T = 1e-9, config.moment_Am2 = 0.5, config.speed_m_s = uniform(), config.turn_rad_s = uniform();
      for (int k = 0; k < 3; ++k) config.lower_m[k] = -0.5 * uniform(), config.upper_m[k] = uniform();
      tracker.start(config);
    }
    if (uniform() < 0.05)
      for (double &x : magnet) x = 2.0 * uniform() - 1.0;
    const double now = next_time(time, 0.1), moment[3] = {0.3, -0.2, 0.4};
    double readings[n][3];
    for (int s = 0; s < n; ++s) {
      double d[3], b[3];
      for (int k = 0; k < 3; ++k) d[k] = config.position_m[s][k] - magnet[k];
      magloc::field(magloc::Ray<double>::from(d), moment, b);
      for (int k = 0; k < 3; ++k) readings[s][k] = magloc::mu0_over_4pi * b[k] + component<double>(1e-9);
    }
    const auto status = tracker.update(now, readings);
    time = tracker.time_s();
    refused += status == magloc::TrackerStatus::bad_time || status == magloc::TrackerStatus::bad_readings ||
               status == magloc::TrackerStatus::no_source || status == magloc::TrackerStatus::contradicts;
    const auto &found = tracker.estimate();
    if (found.components == 0) continue;
    double sum = 0.0;
    for (int k = 0; k < 6; ++k) sum += found.covariance[k][k];
    for (int k = 0; k < 3; ++k) sum += found.position_m[k] + found.moment_Am2[k];
    bad += !isfinite(sum);
  }
}

int main(int, char **arguments) {
  const long count = atol(arguments[1]);
  long refused = 0, bad = 0;
#ifdef QUICK
  run<4>(2 * count, refused, bad);
#else
  run<4>(count, refused, bad);
  run<3>(count / 2, refused, bad);
  run<8>(count - count / 2, refused, bad);
#endif
  printf("updates %ld\nrefused %ld\nnot_finite %ld\n", 2 * count, refused, bad);
}
