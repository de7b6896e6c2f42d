// Random updates of attitude filters: random_updates COUNT. Prints how many it made, how many were refused, and how
// many estimates were not finite. With QUICK only float is tested: each type takes seconds to compile.
#include <stdio.h>
#include <stdlib.h>

#include "adcs/attitude_filter.hpp"
#include "random_readings.hpp"

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
    const double now = next_time(time, 0.02);
    Real gyro[3], acceleration[3], field[3];
    for (int k = 0; k < 3; ++k) {
      gyro[k] = component<Real>(3.0);
      acceleration[k] = component<Real>(2.0) + (Real)(k == 2 ? 9.8 : 0.0);
      field[k] = component<Real>(1e-5) + (Real)(k == 1 ? 2e-5 : 0.0);
    }
    const double missing = uniform();
    const auto status = filter.update(now, missing < 0.1 ? nullptr : gyro, missing > 0.9 ? nullptr : acceleration,
                                      missing > 0.45 && missing < 0.55 ? nullptr : field);
    time = filter.time_s();
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
#ifdef QUICK
  run<float>(2 * count, refused, bad);
#else
  run<double>(count, refused, bad);
  run<float>(count, refused, bad);
#endif
  printf("updates %ld\nrefused %ld\nnot_finite %ld\n", 2 * count, refused, bad);
}
