/* Relays as drives: a requested share of full power, by switching on and off with least times.
 *
 *     static tg_switch switches[TG_RELAYS];
 *     tg_switches_reset(switches, TG_RELAYS);
 *     as often as relays are to be timed, each 0.1 s say, under the drives in force:
 *         tg_switches_pass(tg_the_relays, switches, TG_RELAYS, drive, seconds since the last call);
 *         ... a step where one is due: drive is that of the new move ...
 *         tg_switches_turn(tg_the_relays, switches, TG_RELAYS, drive, running);
 *     and switches[i].on is the state of relay i
 *
 * A relay comes on once it owes half of its shortest pulse and goes off once it owes nothing, neither before its
 * least time is over; one that has an opposite comes on only when that has been off for a dead time.
 */
#ifndef TG_SWITCHES_H
#define TG_SWITCHES_H

typedef struct {
    int drive;    /* which drive it gives */
    int opposite; /* place of the relay that is never on together with it, -1: none */
    double full;  /* of its drive, where it is on; below zero a cooler's */
    double on_s, off_s, dead_s;
} tg_relay;

typedef struct {
    int on;         /* its state */
    int stopped;    /* nothing is requested of it, whatever the drives are */
    int fresh;      /* it has not been on, and for what it waited until then nothing is owed */
    double owed_s;  /* of full power, requested and not given */
    double since_s; /* it last went over */
} tg_switch;

#ifdef __cplusplus
extern "C" {
#endif

/* All off, and only just, for nobody knows better. */
void tg_switches_reset(tg_switch *s, int n);

/* Let time pass under these drives. */
void tg_switches_pass(const tg_relay *r, tg_switch *s, int n, const double *drive, double seconds);

/* Request drives from now on, and switch what is due; where it is not running all go off at once, whatever their
 * least times.  Returns in how many seconds the next one is due. */
double tg_switches_turn(const tg_relay *r, tg_switch *s, int n, const double *drive, int running);

#ifdef __cplusplus
}
#endif

#endif
