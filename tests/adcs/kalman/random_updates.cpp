// Random updates of satellite filters: random_updates COUNT. Prints how many it made, how many were refused, and how
// many estimates were not finite. With QUICK the filters are those with most states, as four take 13 s to compile.
#include <stdio.h>
#include <stdlib.h>

#include "adcs/satellite_filter.hpp"
#include "random_readings.hpp"

using adcs::State;

template <class Real, int... states>
void run(long count, long &refused, long &bad) {
  typedef adcs::SatelliteFilter<Real, states...> Filter;
  static Filter filter;
  double time = 0.0;
  for (long i = 0; i < count; ++i) {
    if (i % 5000 == 0) {
      adcs::SatelliteConfig<Real> config = {};
      for (int k = 0; k < 3; ++k) config.inertia_kgm2[k][k] = (Real)(0.03 + 0.01 * k);
      for (bool &used : config.uses) used = uniform() < 0.8;
      config.uses[0] |= !config.uses[2] || !config.uses[3];
      config.residual_dipole_Am2[0] = (Real)0.01;
      if (uniform() < 0.3) config.gate_limit = INFINITY;
      filter.start(config);
    }
    const double now = next_time(time, 2.0), angle = 1.1e-3 * (now < 1e9 ? now : 0.0), s = sin(angle), c = cos(angle);
    adcs::OrbitPoint<Real> at = {
        {(Real)(6.9e6 * c), 0, (Real)(6.9e6 * s)}, {(Real)(-7590 * s), 0, (Real)(7590 * c)}, {}, {}};
    Real star[4], covariance[9] = {}, gyro[3], field[3], sun[3], wheels[3], torquers[3];
    for (int k = 0; k < 4; ++k) star[k] = component<Real>(0.1) + (Real)(k == 0);
    for (int k = 0; k < 9; ++k)
      covariance[k] = k % 4 == 0 ? component<Real>(1e-9) + (Real)1.5e-9 : component<Real>(1e-10);
    for (int k = 0; k < 3; ++k) {
      at.field_T[k] = component<Real>(1e-5) + (Real)(k == 1 ? 2e-5 : 0.0);
      at.sun[k] = component<Real>(0.2) + (Real)(k == 2);
      gyro[k] = component<Real>(0.01), field[k] = component<Real>(4e-5), sun[k] = component<Real>(1.0);
      wheels[k] = component<Real>(1e-3), torquers[k] = component<Real>(0.1);
    }
    const double missing = uniform();
    adcs::SatelliteReadings<Real> readings;
    if (missing > 0.3) readings.star = star;
    if (missing > 0.8) readings.star_covariance_rad2 = covariance;
    if (missing < 0.8) readings.gyro_rad_s = gyro;
    if (missing > 0.5) readings.field_T = field;
    if (missing < 0.6) readings.sun = sun;
    if (missing > 0.2) readings.wheels_Nms = wheels, readings.torquers_Am2 = torquers;
    const auto status = filter.update(now, readings, at);
    time = filter.time_s();
    refused += status != adcs::Status::ok;
    const auto &found = filter.estimate();
    if (!found.has_attitude()) continue;
    double sum = 0.0;
    for (int k = 0; k < Filter::n; ++k) sum += (double)found.sigma[k];
    for (Real q : found.q) sum += (double)q;
    bad += !isfinite(sum);
  }
}

int main(int, char **arguments) {
  const long count = atol(arguments[1]);
  long refused = 0, bad = 0;
#ifdef QUICK
  const long part = count;
#else
  const long part = count - count / 2;
  run<double>(count / 2, refused, bad);
  run<float, State::gyro_bias>(count / 2, refused, bad);
#endif
  run<double, State::gyro_bias, State::field_model, State::dipole>(part, refused, bad);
  run<float, State::field_bias, State::disturbance, State::field_gain>(part, refused, bad);
  printf("updates %ld\nrefused %ld\nnot_finite %ld\n", 2 * count, refused, bad);
}
