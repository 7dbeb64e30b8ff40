/* Runs a board's ELF under simavr, its serial line on a pseudo-terminal at its true speed.
 *
 *   board_sim MCU ELF      prints the name of the pty; then takes commands on stdin:
 *
 *   adc K MILLIVOLT        what a sensor's pin sees
 *   tacho 0|1              whether the pump, when it is on, turns
 *   status                 prints simulated ms, enable, heat, cool, pump, grip, deepest stack [bytes],
 *                          longest answer [us from the end of a line to the first byte], longest turn of
 *                          the loop [us], the host's lines, boots
 *   forget                 the deepest and the longest begin anew
 *   poke ADDRESS VALUE     writes 32 bits into RAM
 *   hang                   the program hangs in an endless loop
 */
#define _GNU_SOURCE
#include <fcntl.h>
#include <poll.h>
#include <pty.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <termios.h>
#include <time.h>
#include <unistd.h>

#include <simavr/avr_adc.h>
#include <simavr/avr_ioport.h>
#include <simavr/avr_uart.h>
#include <simavr/sim_avr.h>
#include <simavr/sim_elf.h>
#include <simavr/sim_hex.h>

enum { MHZ = 16, BYTE_CYCLES = MHZ * 1000000 / 11520, QUEUE = 65536 };

/* Where config.h's pins are: port and bit; the pulse widths' control and compare registers. */
typedef struct {
  char port;
  int bit;
} pin_t;
typedef struct {
  const char *mcu;
  pin_t enable, heat, cool, pump, grip, tacho;
  int control, heat_compare, heat_on, cool_compare, cool_on;
} board_t;

static const board_t BOARDS[] = {
    {"atmega328p", {'B', 0}, {'B', 1}, {'B', 2}, {'D', 7}, {'D', 6}, {'D', 2}, 0x80, 0x88, 0x80, 0x8A, 0x20},
    {"atmega2560", {'H', 5}, {'H', 6}, {'B', 4}, {'H', 4}, {'H', 3}, {'E', 4}, 0xB0, 0xB4, 0x20, 0xB3, 0x80},
};

static avr_t *avr;
static const board_t *board;
static int line, turns = 1;
static unsigned deepest, boots, lines_in;
static unsigned char queue[QUEUE];
static size_t head, tail;
static avr_cycle_count_t ended, slowest, turned, longest;
static char said[512];
static size_t n_said;

static int level(pin_t pin) {
  avr_ioport_state_t state;
  avr_ioctl(avr, AVR_IOCTL_IOPORT_GETSTATE(pin.port), &state);
  return (int)((state.port & state.ddr) >> pin.bit & 1);
}

static int width(pin_t pin, int compare, int on) {
  return avr->data[board->control] & on ? avr->data[compare] : 255 * level(pin);
}

/* One byte of the host arrives each 87 us, whether the board reads it or not. */
static avr_cycle_count_t arrive(avr_t *of, avr_cycle_count_t when, void *unused) {
  (void)unused;
  if (head != tail) {
    unsigned char byte = queue[tail++ % QUEUE];
    avr_raise_irq(avr_io_getirq(of, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_INPUT), byte);
    if (byte == '\n') ended = of->cycle, ++lines_in;
  }
  return when + BYTE_CYCLES;
}

static void output(struct avr_irq_t *irq, uint32_t value, void *unused) {
  (void)irq, (void)unused;
  unsigned char byte = (unsigned char)value;
  if (ended && head == tail) {
    if (avr->cycle - ended > slowest) slowest = avr->cycle - ended;
    ended = 0;
  }
  if (write(line, &byte, 1) != 1) perror("pty");
  if (n_said < sizeof said - 1) said[n_said++] = (char)byte;
  if (byte == '\n') {
    said[n_said] = 0;
    boots += strstr(said, " boot ") != NULL;
    n_said = 0;
  }
}

/* The pump's tachometer; without the second call a write to the port would put the pull-up's level there. */
static void drive_tacho(avr_irq_t *irq, int high) {
  avr_ioport_external_t outside = {(unsigned long)board->tacho.port, 1u << board->tacho.bit,
                                   (uint8_t)(high << board->tacho.bit)};
  avr_ioctl(avr, AVR_IOCTL_IOPORT_SET_EXTERNAL(board->tacho.port), &outside);
  avr_raise_irq(irq, (uint32_t)high);
}

static void command(char *text) {
  unsigned k;
  unsigned long value, address;
  if (sscanf(text, "adc %u %lu", &k, &value) == 2) {
    avr_raise_irq(avr_io_getirq(avr, AVR_IOCTL_ADC_GETIRQ, ADC_IRQ_ADC0 + (int)k), (uint32_t)value);
  } else if (sscanf(text, "tacho %u", &k) == 1) {
    turns = (int)k;
  } else if (sscanf(text, "poke %lx %lu", &address, &value) == 2) {
    for (k = 0; k < 4; ++k) avr->data[address + k] = (uint8_t)(value >> 8 * k);
  } else if (strncmp(text, "forget", 6) == 0) {
    slowest = longest = turned = ended = deepest = 0;
  } else if (strncmp(text, "hang", 4) == 0) {
    uint32_t end = avr->flashend - 1; /* rjmp to itself, behind the program */
    avr->flash[end] = 0xFF, avr->flash[end + 1] = 0xCF;
    avr->pc = end;
  } else if (strncmp(text, "status", 6) == 0) {
    printf("%.3f %d %d %d %d %d %u %.0f %.0f %u %u\n", (double)avr->cycle / (1000.0 * MHZ), level(board->enable),
           width(board->heat, board->heat_compare, board->heat_on),
           width(board->cool, board->cool_compare, board->cool_on), level(board->pump), level(board->grip),
           deepest, (double)slowest / MHZ, (double)longest / MHZ, lines_in, boots);
    fflush(stdout);
  }
}

/* The loop strokes the watchdog once a turn. */
static void turn(void) {
  if (turned && avr->cycle - turned > longest) longest = avr->cycle - turned;
  turned = avr->cycle;
}

static void listen(void) {
  struct pollfd waiting[2] = {{line, POLLIN, 0}, {0, POLLIN, 0}};
  char text[256];
  if (poll(waiting, 2, 0) <= 0) return;
  if (waiting[0].revents & POLLIN) {
    unsigned char got[256];
    ssize_t n = read(line, got, sizeof got);
    for (ssize_t k = 0; k < n; ++k) queue[head++ % QUEUE] = got[k];
  }
  if (waiting[1].revents & POLLIN) {
    if (fgets(text, sizeof text, stdin) == NULL) exit(0);
    command(text);
  } else if (waiting[1].revents & POLLHUP) {
    exit(0);
  }
}

static double seconds(void) {
  struct timespec now;
  clock_gettime(CLOCK_MONOTONIC, &now);
  return (double)now.tv_sec + 1e-9 * (double)now.tv_nsec;
}

static void open_line(void) {
  int other;
  char name[128];
  struct termios raw;
  if (openpty(&line, &other, name, NULL, NULL) != 0) exit(2);
  tcgetattr(other, &raw);
  cfmakeraw(&raw);
  tcsetattr(other, TCSANOW, &raw);
  fcntl(line, F_SETFL, O_NONBLOCK);
  printf("%s\n", name);
  fflush(stdout);
}

static void connect_uart(void) {
  uint32_t flags = 0;
  avr_ioctl(avr, AVR_IOCTL_UART_SET_FLAGS('0'), &flags); /* neither echo on stdout nor naps */
  avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_OUTPUT), output, NULL);
}

static void quiet(avr_t *of, const int level_, const char *format, va_list values) {
  (void)of, (void)level_, (void)format, (void)values;
}

int main(int argc, char **argv) {
  elf_firmware_t firmware;
  memset(&firmware, 0, sizeof firmware);
  avr_global_logger_set(quiet);
  if (argc != 3 || elf_read_firmware(argv[2], &firmware) != 0) return 2;
  for (size_t k = 0; k < sizeof BOARDS / sizeof *BOARDS; ++k) {
    if (strcmp(argv[1], BOARDS[k].mcu) == 0) board = &BOARDS[k];
  }
  avr = board ? avr_make_mcu_by_name(argv[1]) : NULL;
  if (avr == NULL) return 2;
  avr_init(avr);
  firmware.frequency = MHZ * 1000000;
  avr_load_firmware(avr, &firmware);
  avr->vcc = avr->avcc = avr->aref = 5000;
  setvbuf(stdin, NULL, _IONBF, 0);
  open_line();
  connect_uart();
  avr_irq_t *tacho = avr_io_getirq(avr, AVR_IOCTL_IOPORT_GETIRQ(board->tacho.port), board->tacho.bit);
  double begin = seconds();
  for (unsigned long ms = 1;; ++ms) {
    while (avr->cycle < (avr_cycle_count_t)ms * MHZ * 1000) {
      if (avr->flash[avr->pc] == 0xA8 && avr->flash[avr->pc + 1] == 0x95) turn(); /* wdr */
      int state = avr_run(avr);
      if (state == cpu_Done || state == cpu_Crashed) return 3;
      unsigned used = avr->ramend - (unsigned)(avr->data[0x5D] | avr->data[0x5E] << 8);
      if (used < avr->ramend && used > deepest) deepest = used;
    }
    if (ms % 10 == 0) drive_tacho(tacho, ms / 10 % 2 && turns && level(board->pump));
    if (avr_cycle_timer_status(avr, arrive, NULL) == 0) { /* a reset forgets all timers */
      avr_cycle_timer_register(avr, BYTE_CYCLES, arrive, NULL);
    }
    listen();
    double ahead = begin + 1e-3 * (double)ms - seconds();
    if (ahead > 2e-3) usleep((useconds_t)(1e6 * ahead));
  }
}
