// Items of a kernel, handed to lanes one by one: a lane whose item has ended takes the next one at once.
#pragma once
#include "numbers.hpp"

MAGLOC_BEGIN
template <class T>
class LaneItems {
  int64_t next_, end_, item_[n_lanes<T>] = {};
  int n_active_ = 0;

 public:
  LaneItems(int64_t begin, int64_t end) : next_(begin), end_(end) {}

  // Call begin(lane, item, is_idle) for each lane that is free. When no item is left, a lane repeats the last one
  // without a result. Return whether any lane has an item.
  template <class Begin>
  MAGLOC_INLINE bool refill(const T &is_free, Begin begin) {
    if (n_active_ == 0 && next_ >= end_) return false;  // there may be no item at all to repeat
    for (int lane = 0; lane < n_lanes<T>; ++lane) {
      if (get_lane(is_free, lane) == 0.0) continue;
      const bool is_idle = next_ >= end_;
      item_[lane] = is_idle ? -1 : next_++;
      n_active_ += !is_idle;
      begin(lane, is_idle ? end_ - 1 : item_[lane], is_idle);
    }
    return true;
  }

  // Call end(lane, item) for each lane whose item is done.
  template <class End>
  MAGLOC_INLINE void release(const T &is_done, End end) {
    for (int lane = 0; lane < n_lanes<T>; ++lane) {
      if (get_lane(is_done, lane) == 0.0 || item_[lane] < 0) continue;
      end(lane, item_[lane]);
      --n_active_;
    }
  }
};
MAGLOC_END
