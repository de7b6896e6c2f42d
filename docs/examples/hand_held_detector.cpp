// A hand-held detector: four magnetometers follow a magnet in front of them. The same
// file compiles for a computer and for a microcontroller.
#include "magloc/tracker.hpp"

static magloc::Tracker<4> tracker;

magloc::TrackerConfig<4> detector() {
  return {{{0.0, 0.0, 0.1}, {0.08, 0.0, 0.0}, {-0.04, 0.07, 0.0}, {-0.04, -0.07, 0.0}},
          2e-9,               // T, noise of a reading
          {-0.4, -0.4, 0.1},  // m, where a magnet may appear
          {0.4, 0.4, 0.7},
          0.5,   // A m^2, usual size of a component of its moment
          0.1,   // m/s
          0.1};  // rad/s
}

// Take the readings of a time, in T. Return whether to beep: a magnet whose place is
// known to 2 cm.
bool is_found(double time_s, const double (&readings_T)[4][3]) {
  if (tracker.update(time_s, readings_T) != magloc::TrackerStatus::ok) return false;
  const auto &now = tracker.estimate();
  return now.covariance[0][0] + now.covariance[1][1] + now.covariance[2][2] < 4e-4;
}

#if __STDC_HOSTED__  // a computer, or a microcontroller with a console
#include <stdio.h>

using namespace magloc;

static uint32_t state = 1;
double noise() {  // of unit sigma, about a normal distribution
  double sum = 0.0;
  for (int i = 0; i < 12; ++i) {
    state = state * 1664525u + 1013904223u;
    sum += state / 4294967296.0 - 0.5;
  }
  return sum;
}

// Fifteen seconds, ten rows a second: the magnet passes from left to right. From 6 to 7
// s the last sensor is silent, and the row of 10 s is disturbed.
int main() {
  const magloc::TrackerConfig<4> config = detector();
  tracker.start(config);
  const double moment[3] = {0.3, -0.2, 0.4}, earth[3] = {2e-5, 1e-6, -4.3e-5};
  int found = 0;
  for (int k = 0; k < 150; ++k) {
    const double t = 0.1 * k;
    const double magnet[3] = {-0.3 + 0.04 * t, 0.1, 0.35};
    double readings[4][3];
    for (int s = 0; s < 4; ++s) {
      double d[3], b[3];
      for (int i = 0; i < 3; ++i) d[i] = config.position_m[s][i] - magnet[i];
      field(Ray<double>::from(d), moment, b);
      for (int i = 0; i < 3; ++i)
        readings[s][i] = earth[i] + mu0_over_4pi * b[i] + 2e-9 * noise();
      if (s == 3 && k >= 60 && k < 70) readings[s][0] = nan;
    }
    if (k == 100) readings[1][2] += 1e-6;
    found += is_found(t, readings);
    const auto &now = tracker.estimate();
    if (k % 10 != 0) continue;
    printf("%.1f %d", t, now.components);
    for (double x : now.position_m) printf(" %.12f", x);
    for (double x : now.moment_Am2) printf(" %.12f", x);
    for (int i = 0; i < 6; ++i) printf(" %.12f", square_root(now.covariance[i][i]));
    for (double x : magnet) printf(" %.12f", x);
    printf(" %.9f\n", now.nis);
  }
  printf("found %d\n", found);
  return 0;
}
#endif
