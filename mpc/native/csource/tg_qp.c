/* A dual active-set method for a small convex QP with hard and soft rows.
 *
 * With H = UU' and m_i = U^-1 a_i the dual of the problem, for a set W of rows at their bounds with signs
 * s_i (+1 upper, -1 lower), is
 *
 *     maximise over lambda    - 1/2 lambda' K lambda + r' lambda,
 *     K_ij = s_i s_j m_i'm_j,     r_i = - s_i b_i - s_i m_i'c,     c = U^-1 f,
 *
 * with lambda >= 0.  Rows that end at an entry have normals that end there: those of the first moves, which are at
 * their bounds most of the time, are short.  A soft row with penalties w, q adds to it: up to lambda = w its bound holds; beyond, it is
 * broken by (lambda - w)/q, which adds 1/q to K_ii and w/q to r_i.  So the dual is concave, piecewise
 * quadratic, and a row is in one of four states: outside the set, hard, soft and kept, soft and broken.
 *
 * Start anywhere with lambda >= 0. Solve K lambda* = r (an LDL' factor of K, updated row by row); go toward
 * lambda* until the first multiplier reaches the end of its state, which then changes; repeat. Where all of
 * lambda* is reached, x = U'^-1 (-c - sum s_i m_i lambda_i) fulfils all rows in the set; take in the row that
 * is broken most, or be done.  Each move raises the dual, so that no set comes twice.  (D. Goldfarb, A. Idnani,
 * Mathematical Programming 27, 1983, is the method without soft rows.)
 *
 * Rows may depend on one another: a range and a sum of slews that ends on it.  Every K_ii therefore includes a
 * share of 1e-11 of itself, which keeps the factor regular and the dual strictly concave; multipliers that
 * contradict each other diverge until one reaches its bound. The effect of that share on x is removed at
 * the end by a step of refinement with K itself. Hard rows that cannot be fulfilled together show there.
 *
 * Soft rows may be broken by the dozen, the others are hardly more than there are unknowns. Where soft rows are many
 * (TG_LEAN), the broken ones, b, are eliminated from K z = r, D their diagonal:
 *
 *     S = I + sum_b m m'/D,     T = M S^-1 M' + 1e-11 diag(K),     M the normals of the others, h,
 *     T z_h = r_h - M S^-1 g,   g = sum_b m r_b/D,   v = S^-1 (M' z_h + g),   z_b = (r_b - m'v)/D.
 */
#include "tg_qp.h"

#include <math.h>
#include <string.h>

#define LARGEST 1.7e308 /* number that is finite */
#define TOLERANCE TG_TOLERANCE /* of a row, in units of its own length */
#define REGULAR 1e-11 /* share of K_ii that keeps its factor regular */
#define CONTRADICTION 1e-6 /* by which a hard row may stay broken, in units of its length */
#define SHORT TG_SHORT /* a soft row shorter than this cannot be kept by any plan */
#define CONVEX 1e-14    /* of H_ii, that a pivot is at least */
#define REACHED 1e-13   /* of the largest multiplier: what ends by less beyond its bound is on it */

static double *fit_row(tg_qp *q, int i) { return q->fit + (size_t)i * (size_t)(i + 1) / 2; }

void tg_qp_forget(tg_qp *q) { q->n_work = 0; }

/* Whether none of n numbers, a multiple of four, is infinite or no number, nor their sum. */
static int all_finite(const double *a, int n)
{
    double sum[4] = {0.0}, next[4] = {0.0};
    int i = 0;
    for (; i + 8 <= n; i += 8)
        for (int l = 0; l < 4; l++) {
            sum[l] += fabs(a[i + l]);
            next[l] += fabs(a[i + 4 + l]);
        }
    for (int l = 0; i < n && l < 4; l++)
        sum[l] += fabs(a[i + l]);
    for (int l = 0; l < 4; l++)
        sum[l] += next[l];
    return (sum[0] + sum[1]) + (sum[2] + sum[3]) <= LARGEST;
}

/* Whether H, or what became of it where it has no factor, is. */
static int matrix_is_finite(const tg_qp *q)
{
    for (int i = 0; i < q->n; i++)
        if (!all_finite(q->H + (size_t)i * TG_Q_W, TG_WHOLE(i + 1)))
            return 0;
    return 1;
}

/* Whether all else is: bounds, rows, the linear cost. */
static int problem_is_finite(const tg_qp *q)
{
    int last = q->s - 1, wrong = 0; /* the rows of A are one behind the other */
    for (int i = 0; i < 2 * q->n + q->s; i++)
        wrong |= isnan(q->lower[i]) | isnan(q->upper[i]);
    return !wrong && (q->kept || !q->s || all_finite(q->A, q->start[last] + q->filled[last])) &&
           all_finite(q->f, TG_WHOLE(q->n));
}

double tg_product(const double *a, const double *b, int n)
{
    double sum[4] = {0.0};
    for (int j = 0; j < n; j += 4)
        for (int l = 0; l < 4; l++)
            sum[l] += a[j + l] * b[j + l];
    return (sum[0] + sum[1]) + (sum[2] + sum[3]);
}

void tg_add_row(double *restrict into, double share, const double *restrict row, int n)
{
    for (int j = 0; j < n; j += 4)
        for (int l = j; l < j + 4; l++)
            into[l] += share * row[l];
}

/* The product of two rows of any length. */
static double dot(const double *a, const double *b, int n)
{
    int whole = n & ~3;
    double sum = tg_product(a, b, whole);
    for (int j = whole; j < n; j++)
        sum += a[j] * b[j];
    return sum;
}

/* The products of a row with four rows of n numbers, a multiple of four. */
static void four_products(const double *restrict m, const double *restrict r0, const double *restrict r1,
                          const double *restrict r2, const double *restrict r3, int n, double *out)
{
    double s0[4] = {0.0}, s1[4] = {0.0}, s2[4] = {0.0}, s3[4] = {0.0};
    for (int j = 0; j < n; j += 4)
        for (int l = 0; l < 4; l++) {
            s0[l] += m[j + l] * r0[j + l];
            s1[l] += m[j + l] * r1[j + l];
            s2[l] += m[j + l] * r2[j + l];
            s3[l] += m[j + l] * r3[j + l];
        }
    out[0] = (s0[0] + s0[1]) + (s0[2] + s0[3]);
    out[1] = (s1[0] + s1[1]) + (s1[2] + s1[3]);
    out[2] = (s2[0] + s2[1]) + (s2[2] + s2[3]);
    out[3] = (s3[0] + s3[1]) + (s3[2] + s3[3]);
}

void tg_soft_values(const tg_qp *q, const double *x, double *values)
{
    const double *row = q->A;
    for (int i = 0; i < q->s;) {
        const int n = q->filled[i];
        if (TG_Q_S >= 4 && i + 4 <= q->s && q->filled[i + 3] == n) {
            four_products(x, row, row + n, row + 2 * n, row + 3 * n, n, values + i);
            row += 4 * n;
            i += 4;
        } else {
            values[i++] = tg_product(row, x, n);
            row += n;
        }
    }
}

/* Added and not taken: of sums a compiler makes one instruction a term, of differences not. */
void tg_add_four(double *restrict row, const double *restrict u, int apart, double v0, double v1, double v2, double v3,
                 int n)
{
    const double *u1 = u + apart, *u2 = u1 + apart, *u3 = u2 + apart;
    for (int j = 0; j < n; j += 4)
        for (int l = j; l < j + 4; l++)
            row[l] = row[l] + v0 * u[l] + v1 * u1[l] + v2 * u2[l] + v3 * u3[l];
}

/* Add shares v of four rows, TG_Q_W apart, to a row and w to another one: each number that is read counts twice. */
static void add_four_twice(double *restrict row, double *restrict other, const double *restrict u, double v0, double v1,
                           double v2, double v3, double w0, double w1, double w2, double w3, int n)
{
    const double *u1 = u + TG_Q_W, *u2 = u1 + TG_Q_W, *u3 = u2 + TG_Q_W;
    for (int j = 0; j < n; j += 4)
        for (int l = j; l < j + 4; l++) {
            row[l] = row[l] + v0 * u[l] + v1 * u1[l] + v2 * u2[l] + v3 * u3[l];
            other[l] = other[l] + w0 * u[l] + w1 * u1[l] + w2 * u2[l] + w3 * u3[l];
        }
}

/* The same of two rows. */
static void add_two_twice(double *restrict row, double *restrict other, const double *restrict u, double v0, double v1,
                          double w0, double w1, int n)
{
    const double *u1 = u + TG_Q_W;
    for (int j = 0; j < n; j += 4)
        for (int l = j; l < j + 4; l++) {
            row[l] = row[l] + v0 * u[l] + v1 * u1[l];
            other[l] = other[l] + w0 * u[l] + w1 * u1[l];
        }
}

/* How much each hard row weighs beside the others: 1 over its length, unknowns in units of H_jj^-1/2. */
static int weigh_rows(tg_qp *q)
{
    int n = q->n;
    for (int j = 0; j < n; j++) {
        double diagonal = q->H[(size_t)j * (TG_Q_W + 1)];
        if (!(diagonal > 0.0))
            return 0;
        q->weight[j] = q->weight[n + j] = sqrt(diagonal);
        if (j >= q->stride) {
            double before = q->H[(size_t)(j - q->stride) * (TG_Q_W + 1)];
            q->weight[n + j] = sqrt(diagonal * (before / (diagonal + before)));
        }
    }
    for (int i = 0; i < q->s; i++)
        q->weight[2 * n + i] = -1.0;
    return 1;
}

/* What a row weighs beside the others; 0 where it is too short for any plan to keep it. */
static double weight_of(tg_qp *q, int row)
{
    if (q->weight[row] < 0.0) {
        int i = row - 2 * q->n, filled = q->filled[i] < q->n ? q->filled[i] : q->n;
        const double *a = q->A + q->start[i];
        double sum = 0.0;
        for (int j = 0; j < filled; j++)
            sum += a[j] * a[j] / (q->weight[j] * q->weight[j]);
        q->weight[row] = sum > SHORT * SHORT ? 1.0 / sqrt(sum) : 0.0;
    }
    return q->weight[row];
}

/* Whether a pivot is more than a small share of the square in weight (NULL: than 0), and finite. */
static int is_pivot(double pivot, const double *weight)
{
    return pivot > (weight ? CONVEX * *weight * *weight : 0.0) && pivot <= LARGEST;
}

/* Divide row i of a factor by the root of its pivot, on the diagonal, and put the inverse there. */
static void finish_row(double *restrict row, int i)
{
    const double inverse = 1.0 / sqrt(row[i]);
    for (int j = 0; j <= i; j += 4)
        for (int l = j; l < j + 4; l++)
            row[l] *= inverse;
    row[i] = inverse;
}

/* Replace the lower triangle of n rows of a matrix by U' of UU', two rows at once, from the last, on its diagonal what
 * its own is the inverse of; 0 where one is no pivot.  What becomes of entries behind the diagonal does not count. */
static int factorise(double *H, int n, const double *weight)
{
    int i = n - 1;
    if (n % 2) {
        if (!is_pivot(H[(size_t)i * (TG_Q_W + 1)], weight ? weight + i : NULL))
            return 0;
        finish_row(H + (size_t)i * TG_Q_W, i);
        i--;
    }
    for (; i > 0; i -= 2) {
        double *row = H + (size_t)i * TG_Q_W, *before = row - TG_Q_W;
        int end = TG_WHOLE(i + 1), k = n - 1;
        if (n % 2) {
            const double *u = H + (size_t)k * TG_Q_W;
            tg_add_row(row, -u[i], u, end);
            tg_add_row(before, -u[i - 1], u, end);
            k--;
        }
        while (k > i) { /* rows that are done: two, then four, two at the end */
            int rows = k % 4 == 3 && k - i >= 4 ? 4 : 2;
            const double *u = H + (size_t)(k - rows + 1) * TG_Q_W, *v = u + i, *w = v - 1;
            if (rows == 4)
                add_four_twice(row, before, u, -v[0], -v[TG_Q_W], -v[2 * TG_Q_W], -v[3 * TG_Q_W], -w[0], -w[TG_Q_W],
                               -w[2 * TG_Q_W], -w[3 * TG_Q_W], end);
            else
                add_two_twice(row, before, u, -v[0], -v[TG_Q_W], -w[0], -w[TG_Q_W], end);
            k -= rows;
        }
        if (!is_pivot(row[i], weight ? weight + i : NULL))
            return 0;
        tg_add_row(before, -row[i - 1] / row[i], row, end); /* does not wait for the root */
        if (!is_pivot(before[i - 1], weight ? weight + i - 1 : NULL))
            return 0;
        finish_row(row, i);
        finish_row(before, i - 1);
    }
    return 1;
}

/* The last block of backward where it has fewer than four rows; return how many rows are before it. */
static int last_block(const double *U, int n, double *b)
{
    const int i = n & ~3;
    for (int k = n - 1; k >= i; k--) {
        const double *row = U + (size_t)k * TG_Q_W;
        b[k] *= row[k];
        for (int j = i; j < k; j++)
            b[j] -= row[j] * b[k];
        tg_add_row(b, -b[k], row, i);
    }
    return i;
}

/* A block of four rows of backward, u where their square begins. */
static void square_block(const double *u0, double *y)
{
    const double *u1 = u0 + TG_Q_W, *u2 = u1 + TG_Q_W, *u3 = u2 + TG_Q_W;
    y[3] *= u3[3];
    y[2] = (y[2] - u3[2] * y[3]) * u2[2];
    y[1] = (y[1] - u3[1] * y[3] - u2[1] * y[2]) * u1[1];
    y[0] = (y[0] - u3[0] * y[3] - u2[0] * y[2] - u1[0] * y[1]) * u0[0];
}

/* Replace b by U^-1 b, U' as factorise leaves it; b is 0 behind entry n. */
static void backward(const double *U, int n, double *b)
{
    for (int i = last_block(U, n, b) - 4; i >= 0; i -= 4) {
        const double *u = U + (size_t)i * TG_Q_W, *y = b + i;
        square_block(u + i, b + i);
        tg_add_four(b, u, TG_Q_W, -y[0], -y[1], -y[2], -y[3], i);
    }
}

/* The same of two: neither waits for the other. */
static void backward_two(const double *U, int n, double *b, double *c)
{
    last_block(U, n, c);
    for (int i = last_block(U, n, b) - 4; i >= 0; i -= 4) {
        const double *u = U + (size_t)i * TG_Q_W, *y = b + i, *z = c + i;
        square_block(u + i, b + i);
        square_block(u + i, c + i);
        add_four_twice(b, c, u, -y[0], -y[1], -y[2], -y[3], -z[0], -z[1], -z[2], -z[3], i);
    }
}

/* Replace b, n numbers and zeros behind, by U'^-1 b. */
static void forward(const double *U, int n, double *b)
{
    for (int i = 0; i < n; i += 4) {
        const double *u = U + (size_t)i * TG_Q_W, *u0 = u + i, *u1 = u0 + TG_Q_W, *u2 = u1 + TG_Q_W, *u3 = u2 + TG_Q_W;
        double *y = b + i, sum[4] = {0.0};
        if (n - i < 4) {
            for (int k = 0; k < n - i; k++) {
                const double *row = u0 + (size_t)k * TG_Q_W;
                y[k] -= tg_product(row - i, b, i);
                for (int j = 0; j < k; j++)
                    y[k] -= row[j] * y[j];
                y[k] *= row[k];
            }
        } else {
            if (i)
                four_products(b, u, u + TG_Q_W, u + 2 * TG_Q_W, u + 3 * TG_Q_W, i, sum);
            y[0] = (y[0] - sum[0]) * u0[0];
            y[1] = (y[1] - sum[1] - u1[0] * y[0]) * u1[1];
            y[2] = (y[2] - sum[2] - u2[0] * y[0] - u2[1] * y[1]) * u2[2];
            y[3] = (y[3] - sum[3] - u3[0] * y[0] - u3[1] * y[1] - u3[2] * y[2]) * u3[3];
        }
    }
}

static double value_of(const tg_qp *q, int row)
{
    int n = q->n;
    if (row < n)
        return q->x[row];
    if (row < 2 * n)
        return q->x[row - n] - (row - n >= q->stride ? q->x[row - n - q->stride] : 0.0);
    return tg_product(q->A + q->start[row - 2 * n], q->x, q->filled[row - 2 * n]);
}

/* Put a row with its sign there; return behind how many entries, a multiple of four, it and its normal are 0. */
static int write_row(const tg_qp *q, int row, int side, double *m)
{
    int n = q->n, last = row < n ? row : row - n;
    memset(m, 0, TG_Q_W * sizeof *m);
    if (row < 2 * n) {
        m[last] = side;
        if (row >= n && last >= q->stride)
            m[last - q->stride] = -side;
    } else {
        const double *a = q->A + q->start[row - 2 * n];
        int filled = q->filled[row - 2 * n] < n ? q->filled[row - 2 * n] : n;
        for (int j = 0; j < filled; j++)
            m[j] = side * a[j];
        last = filled - 1;
    }
    return TG_WHOLE(last + 1);
}

static int fewer(int a, int b) { return a < b ? a : b; }

/* The price of breaking a soft row. */
static double price_of(const tg_qp *q, int row)
{
    int at = row - 2 * q->n;
    return at >= q->s - q->per ? q->at_end[at % q->per] : q->price[at % q->per];
}

/* By what its square is dearer. */
static double ratio_of(const tg_qp *q, int row)
{
    return q->ratio[(row - 2 * q->n) % q->per];
}

/* Set the right side of a row in the set from its bound and its state. */
static void set_right(tg_qp *q, int i, double by_c)
{
    double bound = q->side[i] > 0 ? q->upper[q->row[i]] : -q->lower[q->row[i]];
    q->right[i] = (q->state[i] == 2 ? 1.0 / ratio_of(q, q->row[i]) : 0.0) - bound - by_c;
}

/* Of all rows in the set. */
static void set_all_right(tg_qp *q)
{
    for (int i = 0; i < q->n_work; i += 4) {
        const double *m = q->normal + (size_t)i * TG_Q_W;
        double by_c[4];
        four_products(q->c, m, m + TG_Q_W, m + 2 * TG_Q_W, m + 3 * TG_Q_W, TG_WHOLE(q->n), by_c);
        for (int k = 0; k < 4 && i + k < q->n_work; k++)
            set_right(q, i + k, by_c[k]);
    }
}

/* What of its multiplier row i of the set gives way by: the share that keeps K regular, and its price. */
static void set_give(tg_qp *q, int i)
{
    const double *m = q->normal + (size_t)i * TG_Q_W;
    q->give[i] = REGULAR * tg_product(m, m, q->to[i]);
    if (q->state[i] == 2)
        q->give[i] += 1.0 / (ratio_of(q, q->row[i]) * price_of(q, q->row[i]));
}

/* Replace b by L^-1 b, n numbers, L the factor's, whose diagonal is 1. */
static void before_rows(tg_qp *q, double *b, int n)
{
    int k = 0;
    for (; k + 4 <= n; k += 4) {
        const double *r0 = fit_row(q, k), *r1 = r0 + k + 1, *r2 = r1 + k + 2, *r3 = r2 + k + 3;
        double sum[4];
        four_products(b, r0, r1, r2, r3, k, sum);
        b[k] -= sum[0];
        b[k + 1] -= sum[1] + r1[k] * b[k];
        b[k + 2] -= sum[2] + r2[k] * b[k] + r2[k + 1] * b[k + 1];
        b[k + 3] -= sum[3] + r3[k] * b[k] + r3[k + 1] * b[k + 1] + r3[k + 2] * b[k + 2];
    }
    for (; k < n; k++)
        b[k] -= dot(fit_row(q, k), b, k);
}

/* Make row i of the factor of the products there, the last with itself. */
static void finish_fit(tg_qp *q, int i, double give)
{
    double *row = fit_row(q, i), left = row[i] + give;
    before_rows(q, row, i);
    for (int k = 0; k < i; k++) {
        double scaled = row[k] / q->pivot[k];
        left -= scaled * row[k];
        row[k] = scaled;
    }
    row[i] = 1.0;
    q->pivot[i] = left;
}

#if TG_LEAN
/* Add a share of a normal's product with itself to S. */
static void add_broken(tg_qp *q, int i, double share)
{
    const double *m = q->normal + (size_t)i * TG_Q_W;
    for (int j = 0; j < q->to[i]; j++)
        if (m[j] != 0.0)
            tg_add_row(q->soft + (size_t)j * TG_Q_W, share * m[j], m, TG_WHOLE(j + 1));
}

static void append_fit(tg_qp *q, int i)
{
    q->stale = 1;
    if (q->state[i] == 2)
        add_broken(q, i, 1.0 / q->give[i]);
}

static void append_all(tg_qp *q)
{
    for (int i = 0; i < q->n_work; i++)
        append_fit(q, i);
}

static void remove_fit(tg_qp *q, int r)
{
    q->stale = 1;
    if (q->state[r] == 2)
        add_broken(q, r, -1.0 / q->give[r]);
}

/* The set begins anew. */
static void clear_fit(tg_qp *q)
{
    memset(q->soft, 0, (size_t)q->n * TG_Q_W * sizeof(double));
    for (int j = 0; j < q->n; j++)
        q->soft[(size_t)j * (TG_Q_W + 1)] = 1.0;
    q->stale = 1;
}

/* Make U of S = UU', and the factor of T; 0 where there is no room. */
static int make_fit(tg_qp *q)
{
    int n = q->n, end = TG_WHOLE(n);
    q->n_other = 0;
    for (int i = 0; i < q->n_work; i++) {
        if (q->state[i] == 2)
            continue;
        if (q->n_other == TG_Q_K)
            return 0;
        q->other[q->n_other++] = i;
    }
    q->stale = 0;
    memcpy(q->root, q->soft, (size_t)n * TG_Q_W * sizeof(double));
    if (!factorise(q->root, n, NULL)) /* S is at least 1 */
        return 0;
    for (int a = 0; a < q->n_other; a++) {
        double *seen = q->seen + (size_t)a * TG_Q_W;
        memcpy(seen, q->normal + (size_t)q->other[a] * TG_Q_W, TG_Q_W * sizeof *seen);
        backward(q->root, q->to[q->other[a]] < n ? q->to[q->other[a]] : n, seen);
    }
    for (int a = 0; a < q->n_other; a++) {
        double *row = fit_row(q, a);
        for (int b = 0; b <= a; b++)
            row[b] = tg_product(q->seen + (size_t)a * TG_Q_W, q->seen + (size_t)b * TG_Q_W, end);
        finish_fit(q, a, q->give[q->other[a]]);
    }
    return 1;
}
#else
#define TOGETHER 64 /* rows of a factor, four of which are made at once */

#if TG_Q_M >= 4
/* Append rows i to i + 3 of the factor, i + 4 <= TOGETHER, of the products of these rows, behind to of which a row is 0.
 * They are made side by side, number k of row i + c at [4 k + c], so that no sum is across. */
static void append_four(tg_qp *q, const double *rows, const int *to, int i, const double *give)
{
    const double *by = rows + (size_t)i * TG_Q_W;
    double room[4 * TOGETHER], *own = room + 4 * i, own0[4], own1[4], own2[4], own3[4];
    for (int k = 0; k < i + 4; k++)
        four_products(rows + (size_t)k * TG_Q_W, by, by + TG_Q_W, by + 2 * TG_Q_W, by + 3 * TG_Q_W, to[k], room + 4 * k);
    for (int c = 0; c < 4; c++) {
        own0[c] = own[c];
        own1[c] = own[4 + c];
        own2[c] = own[8 + c];
        own3[c] = own[12 + c];
    }
    for (int k = 0; k < i; k++) {
        const double *row = fit_row(q, k), *before = room, inverse = 1.0 / q->pivot[k];
        double *value = room + 4 * k, sum[4] = {0.0}, next[4] = {0.0}, scaled[4];
        for (int j = 0; j + 2 <= k; j += 2, before += 8)
            for (int c = 0; c < 4; c++) {
                sum[c] += row[j] * before[c];
                next[c] += row[j + 1] * before[4 + c];
            }
        if (k % 2)
            for (int c = 0; c < 4; c++)
                sum[c] += row[k - 1] * before[c];
        for (int c = 0; c < 4; c++) {
            value[c] = value[c] - sum[c] - next[c];
            scaled[c] = inverse * value[c];
        }
        for (int c = 0; c < 4; c++) {
            own0[c] -= value[0] * scaled[c];
            own1[c] -= value[1] * scaled[c];
            own2[c] -= value[2] * scaled[c];
            own3[c] -= value[3] * scaled[c];
        }
        for (int c = 0; c < 4; c++)
            fit_row(q, i + c)[k] = scaled[c];
    }
    for (int c = 0; c < 4; c++) {
        own[c] = own0[c];
        own[4 + c] = own1[c];
        own[8 + c] = own2[c];
        own[12 + c] = own3[c];
    }
    for (int c = 0; c < 4; c++)
        own[5 * c] += give[c];
    for (int b = 0; b < 4; b++) { /* and the square of theirs */
        double *row = fit_row(q, i + b) + i;
        for (int k = 0; k < b; k++) {
            row[k] = own[4 * k + b] / own[5 * k];
            for (int c = b; c < 4; c++)
                own[4 * b + c] -= row[k] * own[4 * k + c];
        }
        row[b] = 1.0;
        q->pivot[i + b] = own[5 * b];
    }
}
#endif

/* Append the factor's row i, whose normal is in place. */
static void append_fit(tg_qp *q, int i)
{
    const double *m = q->normal + (size_t)i * TG_Q_W;
    double *row = fit_row(q, i);
    for (int k = 0; k <= i; k += 4) { /* with itself, and at the end with up to three that do not count */
        const double *by = q->normal + (size_t)k * TG_Q_W;
        four_products(m, by, by + TG_Q_W, by + 2 * TG_Q_W, by + 3 * TG_Q_W, q->to[i], row + k);
    }
    finish_fit(q, i, q->give[i]);
}

/* Append all rows of the set from the first. */
static void append_all(tg_qp *q)
{
    int i = 0;
#if TG_Q_M >= 4
    for (; i + 4 <= q->n_work && i + 4 <= TOGETHER; i += 4)
        append_four(q, q->normal, q->to, i, q->give + i);
#endif
    for (; i < q->n_work; i++)
        append_fit(q, i);
}

/* Take row r out of the factor: the remainder is a rank-one change of the rows behind. */
static void remove_fit(tg_qp *q, int r)
{
    double spare[TG_Q_M] = {0.0};
    double weight = q->pivot[r];
    for (int i = r + 1; i < q->n_work; i++)
        spare[i] = fit_row(q, i)[r];
    for (int i = r + 1; i < q->n_work; i++) {
        const double *from = fit_row(q, i);
        double *into = fit_row(q, i - 1);
        for (int j = 0; j < r; j++)
            into[j] = from[j];
        for (int j = r + 1; j <= i; j++)
            into[j - 1] = from[j];
        q->pivot[i - 1] = q->pivot[i];
    }
    for (int i = r; i < q->n_work - 1; i++) { /* D + weight z z', column by column */
        double z = spare[i + 1], before = q->pivot[i], after = before + weight * z * z;
        double gain = weight * z / after;
        weight *= before / after;
        q->pivot[i] = after;
        for (int k = i + 1; k < q->n_work - 1; k++) {
            double *entry = fit_row(q, k) + i;
            spare[k + 1] -= z * *entry;
            *entry += gain * spare[k + 1];
        }
    }
}

static void clear_fit(tg_qp *q) { q->stale = 0; }
static int make_fit(tg_qp *q) { return !q->stale; }
#endif

static void move_entry(tg_qp *q, int from, int into)
{
    q->give[into] = q->give[from];
    memmove(q->normal + (size_t)into * TG_Q_W, q->normal + (size_t)from * TG_Q_W, TG_Q_W * sizeof(double));
    q->row[into] = q->row[from];
    q->to[into] = q->to[from];
    q->side[into] = q->side[from];
    q->state[into] = q->state[from];
    q->multiplier[into] = q->multiplier[from];
    q->right[into] = q->right[from];
}

/* Take entry r out of the set. */
static void drop(tg_qp *q, int r)
{
    remove_fit(q, r);
    q->in_set[q->row[r]] = 0;
    for (int i = r; i < q->n_work - 1; i++)
        move_entry(q, i + 1, i);
    q->n_work--;
}

static double least(const tg_qp *q, int i) { return q->state[i] == 2 ? price_of(q, q->row[i]) : 0.0; }
static double most(const tg_qp *q, int i) { return q->state[i] == 1 ? price_of(q, q->row[i]) : INFINITY; }

/* Put a row behind the set's; its normal is still to be made of it. */
static void place(tg_qp *q, int row, int side, int state, double multiplier)
{
    int i = q->n_work++;
    q->to[i] = write_row(q, row, side, q->normal + (size_t)i * TG_Q_W);
    q->row[i] = row;
    q->side[i] = (signed char)side;
    q->state[i] = (signed char)state;
    q->multiplier[i] = multiplier;
    q->in_set[row] = 1;
}

/* Take a row into the set. */
static void put(tg_qp *q, int row, int side, int state, double multiplier)
{
    int i = q->n_work;
    double *m = q->normal + (size_t)i * TG_Q_W;
    place(q, row, side, state, multiplier);
    backward(q->H, fewer(q->to[i], q->n), m);
    set_right(q, i, tg_product(m, q->c, q->to[i]));
    set_give(q, i);
    append_fit(q, i);
}

/* Entry r has reached the bound of its state: it leaves the set, or becomes broken, or kept. */
static void change(tg_qp *q, int r, int upward)
{
    int row = q->row[r], side = q->side[r], state = q->state[r];
    drop(q, r);
    if (state == 1 && upward)
        put(q, row, side, 2, price_of(q, row));
    if (state == 2)
        put(q, row, side, 1, price_of(q, row));
}

/* Replace b, n numbers, by the solution by the factor, whose own dimension that is. */
static void solve_factor(tg_qp *q, double *b, int n)
{
    before_rows(q, b, n);
    for (int i = n - 1; i >= 0; i--)
        b[i] /= q->pivot[i];
    for (int i = n - 1; i >= 0; i--) {
        const double *row = fit_row(q, i);
        int whole = i & ~3;
        tg_add_row(b, -b[i], row, whole);
        for (int j = whole; j < i; j++)
            b[j] -= row[j] * b[i];
    }
}

/* Replace b by the solution of K z = b. */
#if TG_LEAN
static void solve_fit(tg_qp *q, double *b)
{
    double v[TG_Q_W] = {0.0}, z[TG_Q_K] = {0.0};
    int end = TG_WHOLE(q->n);
    for (int i = 0; i < q->n_work; i++)
        if (q->state[i] == 2)
            tg_add_row(v, b[i] / q->give[i], q->normal + (size_t)i * TG_Q_W, q->to[i]);
    backward(q->root, q->n, v);
    for (int a = 0; a < q->n_other; a++)
        z[a] = b[q->other[a]] - tg_product(q->seen + (size_t)a * TG_Q_W, v, end);
    solve_factor(q, z, q->n_other);
    for (int a = 0; a < q->n_other; a++) {
        b[q->other[a]] = z[a];
        tg_add_row(v, z[a], q->seen + (size_t)a * TG_Q_W, end);
    }
    forward(q->root, q->n, v);
    for (int i = 0; i < q->n_work; i++)
        if (q->state[i] == 2)
            b[i] = (b[i] - tg_product(q->normal + (size_t)i * TG_Q_W, v, q->to[i])) / q->give[i];
}
#else
static void solve_fit(tg_qp *q, double *b) { solve_factor(q, b, q->n_work); }
#endif

static void make_x(tg_qp *q)
{
    int end = TG_WHOLE(q->n), to = 0, i = 0;
    for (int j = 0; j < end; j++)
        q->x[j] = -q->c[j];
    for (int k = 0; k < q->n_work; k++)
        to = q->to[k] > to ? q->to[k] : to;
    for (; i + 4 <= q->n_work; i += 4) {
        const double *by = q->multiplier + i;
        tg_add_four(q->x, q->normal + (size_t)i * TG_Q_W, TG_Q_W, -by[0], -by[1], -by[2], -by[3], to);
    }
    for (; i < q->n_work; i++)
        tg_add_row(q->x, -q->multiplier[i], q->normal + (size_t)i * TG_Q_W, q->to[i]);
    forward(q->H, q->n, q->x);
}

/* Go toward the multipliers that fulfil the set; return -1 where they are reached, else who ended first. */
static int go(tg_qp *q, int *upward)
{
    int which = -1;
    double share = 1.0, scale = 0.0;
    memcpy(q->wanted, q->right, (size_t)q->n_work * sizeof(double));
    solve_fit(q, q->wanted);
    for (int i = 0; i < q->n_work; i++)
        scale = fmax(scale, fabs(q->wanted[i]));
    for (int i = 0; i < q->n_work; i++) {
        double low = least(q, i), high = most(q, i), slack = REACHED * scale;
        double there = q->wanted[i], here = q->multiplier[i], part = 1.0;
        if (there < low - slack)
            part = here > low ? (here - low) / (here - there) : 0.0;
        else if (there > high + slack)
            part = here < high ? (high - here) / (there - here) : 0.0;
        else
            continue;
        if (which < 0 || part < share) {
            share = part;
            which = i;
            *upward = there > high;
        }
    }
    for (int i = 0; i < q->n_work; i++)
        q->multiplier[i] += share * (q->wanted[i] - q->multiplier[i]);
    return which;
}

/* Find the row that is broken most; 0 where none is. */
static int worst(tg_qp *q, int *row, int *side)
{
    double most_broken = TOLERANCE, *value = q->wanted;
    int found = 0, n = q->n;
    for (int j = 0; j < n; j++) {
        value[j] = q->x[j];
        value[n + j] = q->x[j] - (j >= q->stride ? q->x[j - q->stride] : 0.0);
    }
    tg_soft_values(q, q->x, value + 2 * n);
    for (int i = 0; i < 2 * n + q->s; i++) {
        double over = value[i] - q->upper[i], under = q->lower[i] - value[i];
        if (!(over > 0.0 || under > 0.0) || q->in_set[i])
            continue;
        over = q->upper[i] > TG_FAR ? 0.0 : over * weight_of(q, i);
        under = q->lower[i] < -TG_FAR ? 0.0 : under * weight_of(q, i);
        if (over > most_broken || under > most_broken) {
            *row = i;
            *side = over > under ? 1 : -1;
            most_broken = over > under ? over : under;
            found = 1;
        }
    }
    return found;
}

/* Take the last solve's set in again, where its bounds still exist. same: its normals and its factor hold. */
static void take_up(tg_qp *q, int same)
{
    int kept = q->n_work;
    for (int i = 0; same && i < kept; i++)
        same = (q->side[i] > 0 ? q->upper[q->row[i]] : -q->lower[q->row[i]]) <= TG_FAR;
    if (same) {
        for (int i = 0; i < kept; i++)
            q->in_set[q->row[i]] = 1;
        set_all_right(q);
        return;
    }
    q->n_work = 0;
    clear_fit(q);
    for (int i = 0; i < kept; i++) {
        int row = q->row[i], side = q->side[i], state = q->state[i];
        double multiplier = q->multiplier[i], bound;
        if (row >= 2 * q->n + q->s || weight_of(q, row) == 0.0)
            continue;
        bound = side > 0 ? q->upper[row] : -q->lower[row];
        if (bound > TG_FAR)
            continue;
        place(q, row, side, state, multiplier);
    }
    for (int i = 0; i + 2 <= q->n_work; i += 2) {
        double *m = q->normal + (size_t)i * TG_Q_W;
        int end = q->to[i] > q->to[i + 1] ? q->to[i] : q->to[i + 1];
        backward_two(q->H, fewer(end, q->n), m, m + TG_Q_W);
    }
    if (q->n_work % 2)
        backward(q->H, fewer(q->to[q->n_work - 1], q->n), q->normal + (size_t)(q->n_work - 1) * TG_Q_W);
    set_all_right(q);
    for (int i = 0; i < q->n_work; i++)
        set_give(q, i);
    append_all(q);
}

/* Fulfil the rows of the set as K itself requires; return whether the hard ones are. */
static int refine(tg_qp *q)
{
    for (int i = 0; i < q->n_work; i++) {
        double value = q->side[i] * value_of(q, q->row[i]);
        double bound = q->side[i] > 0 ? q->upper[q->row[i]] : -q->lower[q->row[i]];
        q->wanted[i] = value - bound; /* of a kept row it is 0, of a broken one what its multiplier pays */
        if (q->state[i] == 2)
            q->wanted[i] -= (q->multiplier[i] / price_of(q, q->row[i]) - 1.0) / ratio_of(q, q->row[i]);
    }
    solve_fit(q, q->wanted);
    for (int i = 0; i < q->n_work; i++)
        q->multiplier[i] += q->wanted[i];
    make_x(q);
    for (int i = 0; i < q->n_work; i++) {
        double bound = q->side[i] > 0 ? q->upper[q->row[i]] : -q->lower[q->row[i]];
        double over = q->side[i] * value_of(q, q->row[i]) - bound;
        if (q->state[i] == 0 && !(over * q->weight[q->row[i]] < CONTRADICTION))
            return 0;
    }
    return 1;
}

static int failed(tg_qp *q, int status)
{
    tg_qp_forget(q);
    return status;
}

/* Go from the set that is there to the answer. */
static int search(tg_qp *q)
{
    int row = 0, side = 0, upward = 0, which;
    while (q->iterations <= q->iteration_limit) {
        if (q->late && q->late(q->about))
            return failed(q, TG_QP_TIME);
        if (q->stale && !make_fit(q))
            break;
        which = go(q, &upward);
        if (which >= 0) {
            q->iterations++;
            change(q, which, upward);
            continue;
        }
        make_x(q);
        if (!worst(q, &row, &side)) {
            if (!refine(q))
                return failed(q, TG_QP_INFEASIBLE);
            return all_finite(q->x, TG_WHOLE(q->n)) ? TG_QP_SOLVED : failed(q, TG_QP_NOT_FINITE);
        }
        q->iterations++;
        put(q, row, side, row >= 2 * q->n ? 1 : 0, 0.0);
    }
    return failed(q, TG_QP_ITERATIONS);
}

int tg_qp_solve(tg_qp *q)
{
    int status, warm;
    /* a factor that was updated is made anew, or its errors would add up */
    int same = q->kept && !q->iterations && q->n_work > 0;
    q->iterations = 0;
    if (!problem_is_finite(q))
        return failed(q, TG_QP_NOT_FINITE);
    for (int i = 0; i < 2 * q->n; i++)
        if (q->lower[i] > q->upper[i])
            return failed(q, TG_QP_INFEASIBLE);
    if (!q->kept && (!weigh_rows(q) || !factorise(q->H, q->n, q->weight)))
        return failed(q, matrix_is_finite(q) ? TG_QP_NOT_CONVEX : TG_QP_NOT_FINITE);
    q->kept = 1;
    memset(q->c, 0, sizeof q->c);
    memcpy(q->c, q->f, (size_t)q->n * sizeof(double));
    backward(q->H, q->n, q->c);
    memset(q->in_set, 0, sizeof q->in_set);
    take_up(q, same);
    warm = q->n_work > 0;
    status = search(q);
    if (status == TG_QP_ITERATIONS && warm) { /* the last solve's set led astray, or had no room: from nothing */
        int before = q->iterations;
        q->iterations = 0;
        memset(q->in_set, 0, sizeof q->in_set);
        clear_fit(q);
        status = search(q);
        q->iterations += before;
    }
    return status;
}
