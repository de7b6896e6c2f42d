// Random updates of attitude filters: random_updates COUNT. Prints how many it made, how many were refused, and how
// many estimates were not finite.
#include <math.h>
#include <stdio.h>
#include <stdlib.h>

#include "adcs/attitude_filter.hpp"

static uint64_t state = 1;
static double uniform() {
  state = state * 6364136223846793005u + 1442695040888963407u;
  return (double)(state >> 11) / 9007199254740992.0;
}
// A component of about a size, and sometimes NaN, infinite, zero or of any size.
template <class Real>
Real component(double size) {
  const double kind = uniform();
  if (kind < 0.002) return (Real)NAN;
  if (kind < 0.003) return (Real)INFINITY;
  if (kind < 0.005) return 0;
  if (kind < 0.01) return (Real)pow(10.0, 80.0 * uniform() - 40.0);
  return (Real)(size * (2.0 * uniform() - 1.0));
}

template <class Real>
void run(long count, long &refused, long &bad) {
  static adcs::AttitudeFilter<Real> filter;
  double time = 0.0;
  for (long i = 0; i < count; ++i) {
    if (i % 5000 == 0) {
      adcs::AttitudeConfig<Real> config;
      config.lag_s = (Real)(0.04 * uniform());
      config.is_point_sample = uniform() < 0.5;
      config.disturbance = (adcs::Disturbance)(int)(4.0 * uniform());
      filter.start(config);
    }
    const double kind = uniform();
    time += kind < 0.9    ? 0.02 * uniform()
            : kind < 0.95 ? -uniform()
            : kind < 0.99 ? 10.0 * uniform()
                          : pow(10.0, 12.0 * uniform() - 6.0);
    double now = kind > 0.9999 ? INFINITY : kind > 0.9998 ? NAN : time;
    Real gyro[3], acceleration[3], field[3];
    for (int k = 0; k < 3; ++k) {
      gyro[k] = component<Real>(3.0);
      acceleration[k] = component<Real>(2.0) + (Real)(k == 2 ? 9.8 : 0.0);
      field[k] = component<Real>(1e-5) + (Real)(k == 1 ? 2e-5 : 0.0);
    }
    const double missing = uniform();
    const auto status = filter.update(now, missing < 0.1 ? nullptr : gyro, missing > 0.9 ? nullptr : acceleration,
                                      missing > 0.45 && missing < 0.55 ? nullptr : field);
    if (status == adcs::Status::bad_time) time = filter.time_s();
    refused += status != adcs::Status::ok;
    const auto &found = filter.estimate();
    Real sum = found.sigma_tilt + found.sigma_heading;
    for (Real q : found.q) sum += q;
    bad += !isfinite((double)sum);
  }
}

int main(int, char **arguments) {
  const long count = atol(arguments[1]);
  long refused = 0, bad = 0;
  run<double>(count, refused, bad);
  run<float>(count, refused, bad);
  printf("updates %ld\nrefused %ld\nnot_finite %ld\n", 2 * count, refused, bad);
}
