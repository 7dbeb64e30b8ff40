// Runs the firmware's core on a PC: commands on stdin, what it answers and its pins on stdout.
//
//   board gripper|lab            which board
//   begin CAUSE BOOT NOW         a reset; prints the announcement
//   bytes HEX NOW                received bytes; prints each answer
//   sample FLOW NOW V V V        1e-3 degC, open or short
//   pins                         prints enable, drives, pump, grip
//   ntc SUM N                    prints the thermistor's temperature
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <iostream>
#include <sstream>
#include <string>

#include "core.h"

using namespace thermogrip;

static const Board GRIPPER = {{{"drive", "1", -10000, 10000}},
                              1,
                              {{"t_tank", 2000, 60000, true},
                               {"t_surface", 3000, 55000, true},
                               {"t_ambient", 0, 0, false}},
                              3,
                              true,
                              true};
static const Board LAB = {{{"q1", "percent", 0, 1000000}, {"q2", "percent", 0, 1000000}},
                          2,
                          {{"t1", 2000, 80000, true}, {"t2", 2000, 80000, true}},
                          2,
                          false,
                          false};

static int32_t value_of(const std::string &word) {
  if (word == "open") return OPEN;
  if (word == "short") return SHORTED;
  return static_cast<int32_t>(std::atol(word.c_str()));
}

int main() {
  Core core;
  Board board = GRIPPER;
  std::string text, word, cause;
  while (std::getline(std::cin, text)) {
    std::istringstream in(text);
    uint32_t now = 0;
    in >> word;
    if (word == "board") {
      in >> word;
      board = word == "lab" ? LAB : GRIPPER;
    } else if (word == "begin") {
      unsigned boot;
      in >> cause >> boot >> now;
      core.begin(board, cause.c_str(), static_cast<uint16_t>(boot), 12345678, now);
      std::fputs(core.announcement(), stdout);
    } else if (word == "bytes") {
      std::string hex;
      in >> hex >> now;
      for (size_t k = 0; k + 1 < hex.size(); k += 2) {
        core.receive(static_cast<char>(std::stoi(hex.substr(k, 2), nullptr, 16)), now);
        std::fputs(core.answer(), stdout);
      }
    } else if (word == "sample") {
      int flow = 0;
      int32_t values[MAX_SENSORS] = {};
      in >> flow >> now;
      for (uint8_t k = 0; k < board.n_sensors; ++k) {
        in >> word;
        values[k] = value_of(word);
      }
      core.sample(values, flow != 0, now);
    } else if (word == "pins") {
      Outputs pins = core.outputs();
      std::printf("pins %d", pins.enable);
      for (uint8_t k = 0; k < board.n_drives; ++k) std::printf(" %ld", static_cast<long>(pins.drive[k]));
      std::printf(" %d %d\n", pins.pump, pins.grip);
    } else if (word == "ntc") {
      unsigned sum, n;
      in >> sum >> n;
      int32_t got = thermistor(static_cast<uint16_t>(sum), static_cast<uint8_t>(n), 10000.0f, 10000.0f, 3950.0f, true);
      if (got == OPEN) std::puts("open");
      else if (got == SHORTED) std::puts("short");
      else std::printf("%ld\n", static_cast<long>(got));
    }
  }
  return 0;
}
