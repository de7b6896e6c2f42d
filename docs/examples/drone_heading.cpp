// Attitude and heading of a drone, sample by sample: gyro, accelerometer, and a
// magnetometer near motors. The same file compiles for a computer and for a
// microcontroller, in double or (-DREAL=float) in float.
#include "adcs/attitude_filter.hpp"

#ifndef REAL
#define REAL double
#endif
typedef REAL Real;

static adcs::AttitudeFilter<Real> filter;

// Take the readings of a time, in rad/s, m/s^2 and T. A missing one is a null pointer.
// Return whether the heading may steer: known to 10 degrees, and the readings are good.
bool heading_is_good(double time_s, const Real *gyro, const Real *acceleration,
                     const Real *field) {
  if (filter.update(time_s, gyro, acceleration, field) != adcs::Status::ok)
    return false;
  return filter.estimate().sigma_heading < Real(0.17);
}

#if __STDC_HOSTED__  // a computer, or a microcontroller with a console
#include <stdio.h>

using namespace magloc;

double sine(double x) {
  double s, c;
  fill_sine_and_cosine_of_any(x, s, c);
  return s;
}

// A flight of a minute, 100 samples a second: two seconds on the ground, then turns.
// Motors add a field from 25 s on, and the magnetometer is silent from 45 to 48 s.
int main() {
  const double dt = 0.01;
  const Vector<double> north = {{0.0, 20e-6, -43e-6}}, motors = {{8e-6, -6e-6, 10e-6}},
                       bias = {{0.004, -0.003, 0.002}};
  Quaternion<double> q = exponential(Vector<double>{{0.05, -0.03, 0.9}});
  Vector<double> rate = {};
  int good = 0;
  for (int k = 0; k < 6000; ++k) {
    const double t = dt * k, v = t > 2.0 ? t - 2.0 : 0.0;
    q = normalised(q * exponential(dt * rate));
    const Vector<double> shake = {
        {0.3 * sine(40.0 * v), 0.2 * sine(31.0 * v), 0.4 * sine(53.0 * v)}};
    const Vector<double> a = rotate_back(q, Vector<double>{{0.0, 0.0, 9.81}}) + shake;
    Vector<double> b = rotate_back(q, north), w = rate + bias;
    if (t >= 25.0) b += motors;
    Real gyro[3], acceleration[3], field[3];
    for (int i = 0; i < 3; ++i)
      gyro[i] = Real(w[i]), acceleration[i] = Real(a[i]), field[i] = Real(b[i]);
    const bool is_silent = t >= 45.0 && t < 48.0;
    good += heading_is_good(t, gyro, acceleration, is_silent ? nullptr : field);
    rate = {{0.3 * sine(1.3 * v), 0.2 * sine(0.9 * v), 0.8 * sine(0.5 * v)}};
    if (k % 200 != 199) continue;
    const auto &now = filter.estimate();
    printf("%.2f", t);
    const Real found[] = {now.q[0], now.q[1],       now.q[2],
                          now.q[3], now.sigma_tilt, now.sigma_heading};
    for (Real x : found) printf(" %.12f", (double)x);
    printf(" %u\n", (unsigned)now.flags);
  }
  printf("good %d\n", good);
  return 0;
}
#endif
