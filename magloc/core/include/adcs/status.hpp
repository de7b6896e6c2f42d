// What a filter that takes one reading at a time did with a call.
#pragma once
#include "magloc/numbers.hpp"

MAGLOC_BEGIN
// What a call did. Only ok changes the filter, and diverged, which starts it anew.
enum class Status : int32_t {
  ok,
  bad_time,
  bad_gyro,
  bad_acceleration,
  bad_field,
  bad_star,
  bad_sun,
  bad_momentum,
  bad_orbit,
  diverged
};
MAGLOC_END

namespace adcs {
using magloc::Status;
}  // namespace adcs
