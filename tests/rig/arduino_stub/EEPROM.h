#pragma once
struct Memory {
  template <class T> void get(int, T &value) { value = T(); }
  template <class T> void put(int, const T &) {}
};
extern Memory EEPROM;
