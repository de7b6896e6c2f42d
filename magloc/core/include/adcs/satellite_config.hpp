// Inputs and outputs of a satellite's filter.
#pragma once
#include "adcs/mekf.hpp"

MAGLOC_BEGIN
// Noise and states of a satellite's filter. Arrays by state begin with those of State: field bias, gyro bias,
// disturbance, field model, dipole, field gain.
template <class Real>
struct SatelliteConfig {
  Real inertia_kgm2[3][3];           // with the wheels, body axes
  Real residual_dipole_Am2[3] = {};  // body axes
  bool uses[Sensor::count] = {true, true, true, true};
  double step_s = 1.0;           // usual time between updates, to which the process noise refers
  double longest_gap_s = 600.0;  // after a longer one the filter starts anew
  Real sigma_star = Real(8.7266462599716477e-06), sigma_gyro_rad_s = Real(8.7266462599716477e-05);  // star: half angles
  Real sigma_field_T = Real(250e-9), sigma_sun = Real(1.7453292519943296e-3);
  Real field_error_T = 0;                                             // of the field's model, per component
  Real gyro_walk_rad_s = 0, field_walk_T = 0;                         // growth of the biases' sigma in a second
  Real noise_attitude = Real(1e-8), noise_rate_rad_s = Real(1.5e-6);  // sigma that a usual step adds
  Real noise[6] = {Real(1e-9), Real(1e-8), Real(1e-8), 0, Real(1e-7), Real(1e-8)};
  Real start_sigma[6] = {Real(1e-6), Real(1e-3), Real(2e-6), Real(150e-9), Real(0.1), Real(0.05)};
  Real axes_sigma_rad = Real(0.017453292519943295);  // of the field gain's other components
  Real lasts_s[6] = {0, 0, 0, 132, 0, 0};            // time constant of a state; 0: it lasts
  double gate_limit = 30.664849706154268;            // largest NIS of a reading that is used: a good one in a million
};

// Where the satellite is, in the inertial frame (J2000): position and velocity, the field and the direction to the Sun.
template <class Real>
struct OrbitPoint {
  Real position_m[3], velocity_m_s[3], field_T[3], sun[3];
};

// Readings of a time in body axes; null, or a component that is NaN, is missing. Momentum of the wheels and moment of
// the torquers stay until the next ones.
template <class Real>
struct SatelliteReadings {
  const Real *star = nullptr;                                 // (4,) inertial from body, scalar first
  const Real *star_covariance_rad2 = nullptr;                 // (9,) of a small rotation about the body's axes
  const Real *gyro_rad_s = nullptr, *field_T = nullptr;       // (3,)
  const Real *sun = nullptr;                                  // (3,) direction to it, of any length
  const Real *wheels_Nms = nullptr, *torquers_Am2 = nullptr;  // (3,)
};

enum SatelliteFlag : uint32_t {
  satellite_starting = 1,   // no attitude yet
  satellite_restarted = 2,  // after a long gap
  star_rejected = 1 << 4,   // and so on for gyro, field and Sun: the gate rejected the reading
  star_silent = 1 << 8,     // and so on: no reading for a minute
};

template <class Real, int n>
struct SatelliteEstimate {
  Real q[4];                       // inertial from body, scalar first; NaN before the start
  Real rate[3];                    // against inertial space, body axes, rad/s
  Real states[n > 6 ? n - 6 : 1];  // the optional states, in the order of State
  Real sigma[n];                   // of a small rotation about the body's axes (rad), of the rate, and of the states
  double nis[Sensor::count];       // NaN without a reading
  uint32_t flags;                  // of SatelliteFlag

  bool has_attitude() const { return (flags & satellite_starting) == 0; }
};
MAGLOC_END

namespace adcs {
typedef magloc::Optional State;
using magloc::OrbitPoint;
using magloc::SatelliteConfig;
using magloc::SatelliteEstimate;
using magloc::SatelliteFlag;
using magloc::SatelliteReadings;
using magloc::Sensor;
}  // namespace adcs
