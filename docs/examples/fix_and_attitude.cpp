// A fix of a magnet by four magnetometers, and a step of an attitude filter, by the
// headers alone. The same file compiles for a computer and for a microcontroller: it
// needs no exceptions, no heap and no library.
#include "adcs/mekf.hpp"
#include "magloc/refine.hpp"

using namespace magloc;

constexpr int n_sensors = 4, n_starts = 6;
constexpr int workspace_size = 144;  // doubles, by Workspace::size()
constexpr double noise = 1e-9;       // T, of each channel
constexpr double radius = 0.2;  // m; sensors and starts are in radii from the centre
constexpr double sensors[n_sensors][3] = {
    {0.0, 0.0, 1.0}, {0.8, 0.0, -0.6}, {-0.4, 0.6, -0.2}, {-0.4, -0.6, -0.2}};
constexpr double far = 0.8944271909999159, near = 0.4472135954999579;  // two radii
constexpr double starts[n_starts][4] = {{far, 0.0, 0.0, near}, {-far, 0.0, 0.0, near},
                                        {0.0, far, 0.0, near}, {0.0, -far, 0.0, near},
                                        {0.0, 0.0, far, near}, {0.0, 0.0, -far, near}};

struct Magnet {
  double position[3], moment[3];  // m, A m^2
  double chi2;                    // infinite if there is no fix
};

// Fit a dipole to readings in tesla. The field that all sensors share is unknown.
Magnet locate(const double (&readings)[n_sensors][3]) {
  double y[n_sensors][3], gain[n_sensors][3][3] = {};  // in units of the noise
  for (int a = 0; a < 3; ++a) {
    double mean = 0.0;
    for (int s = 0; s < n_sensors; ++s) mean += readings[s][a] / n_sensors;
    for (int s = 0; s < n_sensors; ++s)
      y[s][a] = (readings[s][a] - mean) / noise, gain[s][a][a] = 1.0 / noise;
  }
  magloc_channels array = {};
  array.n_sensors = n_sensors, array.sensors = sensors[0];
  array.n_channels = 3 * n_sensors, array.gain = gain[0][0];
  array.n_sets = 1, array.is_isotropic = 1;

  double q[n_starts][4], mu[n_starts][3], chi2[n_starts], memory[workspace_size];
  int64_t iterations[n_starts], row[n_starts] = {};  // all fit the same readings
  uint8_t converged[n_starts];
  Workspace workspace(memory);
  Isotropic<double> channels(array, y[0], workspace);
  Refinement<double, 1> refinement(channels, workspace);
  refinement.run(channels, {n_starts, row, starts[0], nullptr, nullptr},
                 {1e-10, 1e-14, 100, false, false, nullptr},
                 {q[0], mu[0], chi2, iterations, converged});
  Magnet magnet = {{}, {}, infinity};
  for (int k = 0; k < n_starts; ++k) {
    if (!converged[k] || !(chi2[k] < magnet.chi2)) continue;
    const double scale = radius / __builtin_fabs(q[k][3]);
    for (int a = 0; a < 3; ++a) {
      magnet.position[a] = radius * q[k][a] / q[k][3];
      magnet.moment[a] = scale * scale * scale / mu0_over_4pi * mu[k][a];
    }
    magnet.chi2 = chi2[k];
  }
  return magnet;
}

// Move the filter on by dt. Take what gyro, magnetometer and Sun sensor then read, but
// not what fits so badly as a good reading does once in a million.
void take_step(Hypothesis<> &filter, const FilterModel<> &satellite,
               const Instant<> &before, const Instant<> &now,
               const Readings<> &readings, double dt) {
  const double kept[6] = {1.0, 1.0, 1.0, 1.0, 1.0, 1.0},
               growth[6] = {1e-12, 1e-12, 1e-12, 1e-12, 1e-12, 1e-12};
  filter.predict(satellite, before, now, kept, growth, dt);
  filter.begin_readings();
  for (int sensor = Sensor::gyro; sensor < Sensor::count; ++sensor)
    if (filter.update(satellite, now, readings, sensor).eased > 30.66) filter.undo();
  filter.correct(satellite);
}

#if __STDC_HOSTED__  // a computer
#include <stdio.h>

void print(const char *name, const double *x, int n) {
  printf("%s", name);
  for (int i = 0; i < n; ++i) printf(" %.17g", x[i]);
  printf("\n");
}

int main() {
  const Magnet magnet = locate({{19696.7e-9, 714.6e-9, -42670.3e-9},
                                {19111.9e-9, 1523.7e-9, -44556.7e-9},
                                {19637.1e-9, 1116.5e-9, -43813.1e-9},
                                {19412.4e-9, 1005.9e-9, -43748.2e-9}});
  print("position", magnet.position, 3);
  print("moment", magnet.moment, 3);

  const double inertia[9] = {0.05, 0.0, 0.0, 0.0, 0.06, 0.0, 0.0, 0.0, 0.03};
  const double inverse[9] = {20.0, 0.0, 0.0, 0.0, 1 / 0.06, 0.0, 0.0, 0.0, 1 / 0.03};
  FilterModel<> satellite = {};
  satellite.body = {matrix_at(inertia), matrix_at(inverse)};
  satellite.states.places = places_of<>();  // attitude and rate, no optional states
  satellite.variance[Sensor::gyro] = 1e-8;  // (rad/s)^2
  satellite.variance[Sensor::magnetometer] = 4e-14;  // T^2
  satellite.variance[Sensor::sun_sensor] = 2.5e-5;   // of a unit vector
  Instant<> instant = {};
  instant.wheels.momentum = {{1e-3, -2e-3, 5e-4}};
  instant.around.orbital_rate = 1.1e-3;
  instant.around.gravity = 1.2e-6;  // mu/r^3
  instant.around.field = {{2e-5, 1e-6, -3e-5}};
  instant.sun = {{0.6, 0.0, 0.8}};
  Readings<> readings = {};
  readings.gyro = {{1e-3, 2e-3, -1e-3}};
  readings.field = {{1.9e-5, 2.1e-6, -3.1e-5}};
  readings.sun = {{0.61, 0.02, 0.79}};
  static Hypothesis<> filter;
  filter.start({{identity, {{0.0, 1.1e-3, 0.0}}}, {}});
  for (int i = 0; i < 6; ++i) filter.P()[i][i] = i < 3 ? 1e-3 : 1e-5;
  take_step(filter, satellite, instant, instant, readings, 1.0);
  double q[4], sigma[6];
  store(filter.x.motion.q, q);
  for (int i = 0; i < 6; ++i) sigma[i] = square_root(filter.P()[i][i]);
  print("attitude", q, 4);
  print("rate", filter.x.motion.w.at, 3);
  print("sigma", sigma, 6);
}
#endif
