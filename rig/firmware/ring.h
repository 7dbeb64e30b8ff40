// The readings that the device takes by its own clock, kept until the host has them.
//
// Ticks are numbered from 0, one every period; the newest are kept, and for a tick that the loop came too late
// for there is a hole.  rig/firmware/ring_buffer.py does the same in Python.

#ifndef THERMOGRIP_RING_H
#define THERMOGRIP_RING_H

#include <stddef.h>
#include <stdint.h>

namespace thermogrip {

const uint8_t CELLS = 120;  // numbers that are kept: 480 bytes of the 2048 of an ATmega328P
const uint32_t MIN_PERIOD_MS = 10, MAX_PERIOD_MS = 1000;

// One tick: how old it is, the pump then, and the drives and temperatures; no numbers where it is a hole.
struct Kept {
  uint16_t age_ms;
  bool pump;
  const int32_t *numbers;
};

class Ring {
 public:
  // Take a reading of so many numbers every so many ms from now on; 0 ms takes none.
  void start(uint32_t period_ms, uint8_t n_numbers, uint32_t now_ms);

  bool running() const { return period_ms_ > 0; }
  bool due(uint32_t now_ms) const;

  // Keep the reading of the newest tick that is due and return where its numbers go; those before it are holes.
  int32_t *keep(bool pump, uint32_t now_ms);

  // Forget everything before this number; false if that has not come yet.
  bool forget(uint32_t number);

  uint32_t first() const { return first_; }
  uint32_t next() const { return first_ + count_; }
  uint8_t count() const { return count_; }

  // The reading at a place from the first, as it is now.
  Kept at(uint8_t place, uint32_t now_ms) const;

 private:
  uint8_t slot(uint8_t place) const;
  int32_t *push();

  int32_t cells_[CELLS];  // of each tick the clock's low half with two flags, and its numbers
  uint32_t period_ms_, due_ms_, first_;
  uint8_t stride_, size_, head_, count_;
};

}  // namespace thermogrip

#endif
