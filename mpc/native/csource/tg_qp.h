/* A quadratic program with few unknowns, by a dual active-set method; no malloc.
 *
 *   minimise    1/2 x'Hx + f'x + sum over soft rows price (s + 1/2 ratio s^2)
 *   subject to  lower <= x <= upper                   rows 0 .. n-1, hard
 *               lower <= x_i - x_(i-stride) <= upper  rows n .. 2n-1, hard; x_(negative) is 0
 *               lower - s <= A x <= upper + s, s >= 0 rows 2n .. 2n+s-1, soft
 *
 * The theory is at the head of tg_qp.c.
 */
#ifndef TG_QP_H
#define TG_QP_H

#include "tg_config.h"

#define TG_FAR 1e15 /* a bound beyond it is none */

#define TG_Q_N (TG_NB * TG_NU)
#define TG_Q_S (TG_NH * TG_NS)
#define TG_Q_M (2 * TG_Q_N + TG_Q_S)

/* Rows are stored in whole groups of four numbers, zeros behind their last, and worked through four at a time. */
#define TG_WHOLE(n) (((n) + 3) & ~3)
#define TG_Q_W (((TG_Q_N) + 3) / 4 * 4)

/* Of few unknowns and many soft rows (TG_LEAN: four times as many) the factor is of the rows that hold alone, of which
 * there are hardly more than unknowns; those that are broken are in a matrix of the unknowns.  So the room grows with
 * the rows, not their square. */
#define TG_Q_K (TG_LEAN ? 4 * TG_Q_N + 8 : TG_Q_M)
#define TG_Q_L (TG_LEAN ? TG_Q_N * TG_Q_W : 1)

enum tg_qp_status {
    TG_QP_SOLVED = 0,
    TG_QP_INFEASIBLE = 1,
    TG_QP_ITERATIONS = 2,
    TG_QP_NOT_CONVEX = 3,
    TG_QP_NOT_FINITE = 4,
    TG_QP_TIME = 5
};

typedef struct {
    /* the problem */
    int n, stride, s, per; /* per: soft rows in a sample */
    double H[TG_Q_N * TG_Q_W]; /* lower triangle, rows of TG_Q_W; U' of H = UU' afterwards, its diagonal inverted */
    double f[TG_Q_W];
    double lower[TG_Q_M], upper[TG_Q_M]; /* beyond +-1e15: none */
    const double *A; /* soft row i begins at start[i], where the one before ends, and has filled[i] entries, zeros
                      * behind; a multiple of four, and no fewer than the row before */
    int start[TG_Q_S > 0 ? TG_Q_S : 1], filled[TG_Q_S > 0 ? TG_Q_S : 1];
    double price[TG_NS > 0 ? TG_NS : 1], at_end[TG_NS > 0 ? TG_NS : 1]; /* of a sample's soft rows; of the last one's */
    double ratio[TG_NS > 0 ? TG_NS : 1];
    int iteration_limit, kept; /* whether H (its factor) and A are those of the last solve */
    int (*late)(void *about); /* asked before every change of the working set: time is up; may be NULL */
    void *about;
    /* the answer */
    double x[TG_Q_W];
    int iterations; /* changes of the working set */
    /* the working set, kept from one solve to the next; rows may depend on one another, so that
     * it can be longer than there are unknowns and soft rows */
    int n_work;
    int row[TG_Q_M], to[TG_Q_M]; /* which, and behind how many entries its normal is 0 */
    signed char side[TG_Q_M];  /* +1 at the upper bound, -1 at the lower */
    signed char state[TG_Q_M]; /* 0 hard, 1 soft and kept, 2 soft and broken */
    double multiplier[TG_Q_M];
    /* room to work in */
    double c[TG_Q_W];                  /* U^-1 f */
    double weight[TG_Q_M];             /* of a soft row not before it is asked for, -1 */
    double normal[(TG_Q_M + 3) * TG_Q_W]; /* side * U^-1 a of each row in the set; groups of four are whole */
    double fit[TG_Q_K * (TG_Q_K + 1) / 2 + 3], pivot[TG_Q_K]; /* LDL' of their products */
    double give[TG_Q_M];                   /* what of its multiplier a row in the set gives way by */
    double soft[TG_Q_L], root[TG_Q_L];     /* 1 and the products of the broken rows, and U of it */
    double seen[TG_LEAN ? TG_Q_K * TG_Q_W : 1]; /* U^-1 of the normals of the others, */
    int other[TG_Q_K], n_other, stale;     /* which those are, and whether all this is to be made anew */
    double right[TG_Q_M], wanted[TG_Q_M]; /* wanted: of the rows in the set; at times a value of each row */
    signed char in_set[TG_Q_M];
} tg_qp;

#ifdef __cplusplus
extern "C" {
#endif

/* Throw the working set away: the next solve starts cold. */
void tg_qp_forget(tg_qp *q);

/* Solve; return one of enum tg_qp_status. The working set is kept where it was solved; whoever gives another H or A
 * sets kept to 0 before, and it is 1 afterwards where there is a factor. */
int tg_qp_solve(tg_qp *q);

/* The product of two rows of n numbers, a multiple of four. */
double tg_product(const double *a, const double *b, int n);

/* Add v times four rows of n numbers, a multiple of four, that lie `apart` from each other, to a row. */
void tg_add_four(double *into, const double *rows, int apart, double v0, double v1, double v2, double v3, int n);

/* The values of all soft rows at x, which has zeros behind. */
void tg_soft_values(const tg_qp *q, const double *x, double *values);

/* Add a share of a row of n numbers, a multiple of four, to another one. */
void tg_add_row(double *into, double share, const double *row, int n);

#ifdef __cplusplus
}
#endif

#endif
