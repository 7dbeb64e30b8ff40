#include "ring.h"

namespace thermogrip {

namespace {

const int32_t THERE = 0x20000, PUMP = 0x10000, CLOCK = 0xFFFF;

}  // namespace

void Ring::start(uint32_t period_ms, uint8_t n_numbers, uint32_t now_ms) {
  period_ms_ = period_ms;
  due_ms_ = now_ms;
  first_ = 0;
  stride_ = static_cast<uint8_t>(1 + n_numbers);
  size_ = static_cast<uint8_t>(CELLS / stride_);
  head_ = count_ = 0;
}

bool Ring::due(uint32_t now_ms) const { return running() && static_cast<int32_t>(now_ms - due_ms_) >= 0; }

int32_t *Ring::keep(bool pump, uint32_t now_ms) {
  uint32_t late = (now_ms - due_ms_) / period_ms_;
  if (late > CELLS) {  // more holes than fit: they only count
    first_ += count_ + late - CELLS;
    due_ms_ += (late - CELLS) * period_ms_;
    count_ = 0;
    late = CELLS;
  }
  while (late-- > 0) *push() = 0;
  int32_t *cell = push();
  *cell = THERE | (pump ? PUMP : 0) | static_cast<int32_t>(now_ms & 0xFFFFu);
  return cell + 1;
}

bool Ring::forget(uint32_t number) {
  uint32_t ahead = next() - number;
  if (ahead > static_cast<uint32_t>(INT32_MAX)) return false;
  while (count_ > ahead) {
    head_ = slot(1);
    --count_;
    ++first_;
  }
  return true;
}

Kept Ring::at(uint8_t place, uint32_t now_ms) const {
  const int32_t *cell = cells_ + slot(place) * stride_;
  uint16_t age = static_cast<uint16_t>(now_ms - static_cast<uint32_t>(*cell & CLOCK));
  return {age, (*cell & PUMP) != 0, (*cell & THERE) != 0 ? cell + 1 : nullptr};
}

uint8_t Ring::slot(uint8_t place) const { return static_cast<uint8_t>((head_ + place) % size_); }

// Make room for one tick, at the cost of the oldest, and return where it goes.
int32_t *Ring::push() {
  if (count_ == size_) {
    head_ = slot(1);
    --count_;
    ++first_;
  }
  int32_t *cell = cells_ + slot(count_) * stride_;
  ++count_;
  due_ms_ += period_ms_;
  return cell;
}

}  // namespace thermogrip
