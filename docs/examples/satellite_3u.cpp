// Attitude of a 3U satellite, sample by sample: star tracker, gyro, magnetometer and
// Sun sensor; the gyro's bias is estimated. The same file compiles for a computer and
// for a microcontroller, in double or (-DREAL=float) in float.
#include "adcs/satellite_filter.hpp"

#ifndef REAL
#define REAL double
#endif
typedef REAL Real;
typedef adcs::SatelliteFilter<Real, adcs::State::gyro_bias> Filter;

static Filter filter;

adcs::SatelliteConfig<Real> satellite() {
  adcs::SatelliteConfig<Real> config = {};
  config.inertia_kgm2[0][0] = config.inertia_kgm2[1][1] = Real(0.035);
  config.inertia_kgm2[2][2] = Real(0.007);
  config.sigma_star = Real(2.5e-5);  // of half angles
  config.sigma_gyro_rad_s = Real(1e-4);
  config.sigma_field_T = Real(200e-9);
  config.sigma_sun = Real(5e-3);
  config.noise_rate_rad_s = Real(2e-5);  // that unknown torques add in a second
  return config;
}

// Take the readings of a second. Return whether the attitude may point an antenna:
// known to 0.1 degrees about each axis, and the readings are good.
bool may_point(double time_s, const adcs::SatelliteReadings<Real> &readings,
               const adcs::OrbitPoint<Real> &orbit) {
  if (filter.update(time_s, readings, orbit) != adcs::Status::ok) return false;
  const auto &now = filter.estimate();
  return now.sigma[0] < Real(5e-4) && now.sigma[1] < Real(5e-4) &&
         now.sigma[2] < Real(5e-4);
}

#if __STDC_HOSTED__  // a computer, or a microcontroller with a console
#include <stdio.h>

using namespace magloc;

static uint32_t state = 1;
double noise(double sigma) {  // of about a normal distribution
  double sum = 0.0;
  for (int i = 0; i < 12; ++i) {
    state = state * 1664525u + 1013904223u;
    sum += state / 4294967296.0 - 0.5;
  }
  return sigma * sum;
}
Vector<double> noisy(const Vector<double> &v, double sigma) {
  return v + Vector<double>{{noise(sigma), noise(sigma), noise(sigma)}};
}
void fill(const Vector<double> &v, Real *out) {
  for (int i = 0; i < 3; ++i) out[i] = Real(v[i]);
}

// Fifteen minutes of a polar orbit. The satellite turns with it. The star tracker is
// blind from 300 to 480 s, and its fix of 600 s is wrong by 0.01 rad.
int main() {
  filter.start(satellite());
  const Vector<double> north = {{0.17, 0.05, 0.98}}, sun = {{0.6, -0.7, 0.4}},
                       rate = {{0.0, 1.1e-3, 0.0}}, bias = {{4e-4, -3e-4, 2e-4}};
  Quaternion<double> q = exponential(Vector<double>{{0.3, -0.8, 1.9}});
  int good = 0;
  for (int k = 0; k < 900; ++k) {
    double s, c;
    fill_sine_and_cosine_of_any(1.1e-3 * k, s, c);
    const Vector<double> up = {{c, 0.0, s}}, ahead = {{-s, 0.0, c}};
    const Vector<double> field = 2.6e-5 * (3.0 * dot(north, up) * up - north);
    adcs::OrbitPoint<Real> orbit;
    fill(6.92e6 * up, orbit.position_m);
    fill(7590.0 * ahead, orbit.velocity_m_s);
    fill(field, orbit.field_T);
    fill(sun, orbit.sun);
    const Quaternion<double> fix = q * exponential(noisy({}, 5e-5)),
                             wrong = q * exponential(Vector<double>{{0.01, 0.0, 0.0}});
    const Quaternion<double> &star_fix = k == 600 ? wrong : fix;
    Real star[4] = {Real(star_fix.scalar)}, gyro[3], magnetometer[3], sun_sensor[3];
    fill(star_fix.vector, star + 1);
    fill(noisy(rate + bias, 1e-4), gyro);
    fill(noisy(rotate_back(q, field), 200e-9), magnetometer);
    fill(noisy(rotate_back(q, normalised(sun)), 5e-3), sun_sensor);
    adcs::SatelliteReadings<Real> readings;
    if (k < 300 || k >= 480) readings.star = star;
    readings.gyro_rad_s = gyro, readings.field_T = magnetometer;
    if (k % 4 == 0) readings.sun = sun_sensor;
    good += may_point(k, readings, orbit);
    const auto &now = filter.estimate();
    if (k % 60 == 0) {
      printf("%d", k);
      for (Real x : now.q) printf(" %.12f", (double)x);
      for (Real x : now.states) printf(" %.12f", (double)x);
      for (Real x : now.sigma) printf(" %.12f", (double)x);
      printf(" %u %.12f %.12f %.12f %.12f\n", (unsigned)now.flags, q.scalar,
             q.vector[0], q.vector[1], q.vector[2]);
    }
    q = normalised(q * exponential(rate));
  }
  printf("good %d\n", good);
  return 0;
}
#endif
