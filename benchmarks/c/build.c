/* Breadth-first enumeration of a game by hand: what pharos builds, with the rules of one game written out in C.
 *
 *     gcc -O3 -march=native -DBREAKOUT -DHEIGHT=12 -DCOLUMNS=8 -DROWS=2 -DEXTRA=0 build.c -o build
 *     gcc -O3 -march=native -DFREEWAY -DCARS=16 -DLENGTH=7 -DSPEED=1 build.c -o build
 *     build LOG2_OF_TABLE FOLDER
 *
 * First in, first out; a table of 32-bit indices with keys looked up in the array of states, at most half full; a batch of
 * states is expanded and their slots prefetched before they are inserted. The table begins with 2^16 slots and doubles
 * when it is half full, as that of pharos does; LOG2_OF_TABLE is its final size, which bounds the arrays, in address space.
 * With -DFINAL_SIZE it has that size from the start. Writes states and successors to FOLDER; with -DSYNC they are on the
 * disk at the end. Prints states, terminal states, depth, seconds, and seconds of processor time.
 */
#define _GNU_SOURCE
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <time.h>
#include <unistd.h>

#define BATCH 16
typedef uint64_t u64;

#ifdef BREAKOUT
enum { PADDLE_WIDTH = 1 + 2 * EXTRA, BRICKS = ROWS * COLUMNS, WORDS = 1, ACTIONS = 3 };
typedef struct { int row, column, right, down, paddle; u64 bricks; } State;
#define FULL ((BRICKS == 64) ? ~0ull : ((1ull << BRICKS) - 1))

static State start(void) {
    State s = {ROWS + 1, (COLUMNS - 1) / 2, 1, 1, (COLUMNS - PADDLE_WIDTH) / 2, FULL};
    return s;
}
static inline int terminal(const State *s) { return s->row == HEIGHT - 1; }
static inline State step(const State *s, int action) {
    State t = *s;
    if (action == 0 && t.paddle > 0) t.paddle--;
    if (action == 2 && t.paddle < COLUMNS - PADDLE_WIDTH) t.paddle++;
    int right = s->right, down = s->down;
    if (s->column == 0) right = 1;
    else if (s->column == COLUMNS - 1) right = 0;
    if (s->row == 0) down = 1;
    int row = s->row + 2 * down - 1, column = s->column + 2 * right - 1;
    if (row == HEIGHT - 1) {
        int hit = 0;
        if (t.paddle <= column && column < t.paddle + PADDLE_WIDTH) hit = 1;
        else if (t.paddle <= s->column && s->column < t.paddle + PADDLE_WIDTH) {
            hit = 1;
            right = 1 - right;
            column = s->column + 2 * right - 1;
            if (column < 0) column = 0;
            if (column > COLUMNS - 1) column = COLUMNS - 1;
        }
        if (hit) {
            down = 0;
            row = s->row;
            if (t.bricks == 0) t.bricks = FULL;
        }
    } else if (1 <= row && row <= ROWS) {
        u64 brick = 1ull << ((row - 1) * COLUMNS + column);
        if (s->bricks & brick) {
            t.bricks &= ~brick;
            down = 1 - down;
            row = s->row;
            column = s->column;
        }
    }
    t.row = row, t.column = column, t.right = right, t.down = down;
    return t;
}
static inline void pack(const State *s, u64 *w) {
    w[0] = s->bricks | (u64)s->row << 40 | (u64)s->column << 46 | (u64)s->right << 51 | (u64)s->down << 52 | (u64)s->paddle << 53;
}
static inline void unpack(const u64 *w, State *s) {
    s->bricks = w[0] & FULL;
    s->row = w[0] >> 40 & 63, s->column = w[0] >> 46 & 31, s->right = w[0] >> 51 & 1, s->down = w[0] >> 52 & 1, s->paddle = w[0] >> 53 & 31;
}
#endif

#ifdef FREEWAY
static const int PERIODS[9] = {1, 2, 3, 4, 5, 6, 7, 8, 11};
enum { ACTIONS = 3, BITS = 8 * CARS + 16, WORDS = (BITS + 63) / 64 };
typedef struct { int row, timer; unsigned char cars[CARS], timers[CARS]; } State;

static State start(void) {
    State s;
    memset(&s, 0, sizeof s);
    s.row = CARS + 1;
    return s;
}
static inline int terminal(const State *s) { return s->row == 0; }
static inline State step(const State *s, int action) {
    State t = *s;
    int row = s->row;
    if (s->timer == 0) {
        if (action == 1 && row > 0) row--;
        else if (action == 2 && 0 < row && row < CARS + 1) row++;
    }
    t.timer = s->timer + 1 == SPEED ? 0 : s->timer + 1;
    for (int i = 0; i < CARS; i++) {
        int timer = s->timers[i] + 1;
        if (timer == PERIODS[i % 9]) {
            timer = 0;
            int position = s->cars[i] + (i % 2 ? -1 : 1);
            if (position == LENGTH) position = 0;
            if (position < 0) position = LENGTH - 1;
            t.cars[i] = position;
        }
        t.timers[i] = timer;
    }
    if (1 <= row && row <= CARS && t.cars[row - 1] == LENGTH / 2) row = CARS + 1;
    t.row = row;
    return t;
}
static inline void pack(const State *s, u64 *w) { /* 8 bits a car: position and timer, 4 bits each; then row and timer */
    for (int k = 0; k < WORDS; k++) w[k] = 0;
    for (int i = 0; i < CARS; i++) w[i / 8] |= (u64)(s->cars[i] | s->timers[i] << 4) << i % 8 * 8;
    w[CARS / 8] |= (u64)(s->row | s->timer << 8) << CARS % 8 * 8;
#if CARS % 8 == 7
    w[CARS / 8 + 1] |= s->timer;
#endif
}
static inline void unpack(const u64 *w, State *s) {
    for (int i = 0; i < CARS; i++) {
        unsigned byte = w[i / 8] >> i % 8 * 8 & 255;
        s->cars[i] = byte & 15, s->timers[i] = byte >> 4;
    }
    u64 tail = w[CARS / 8] >> CARS % 8 * 8;
    s->row = tail & 255;
    s->timer = tail >> 8 & 255;
}
#endif

static inline u64 hash(const u64 *w) {
    u64 h = 0;
    for (int k = 0; k < WORDS; k++) {
        h = (h ^ w[k]) * 0x9E3779B97F4A7C15ull;
        h ^= h >> 32;
    }
    return h;
}

static void *room(size_t bytes) {
    void *p = mmap(0, bytes, PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS | MAP_NORESERVE, -1, 0);
    if (p == MAP_FAILED) exit(2);
    madvise(p, bytes, MADV_HUGEPAGE);
    return p;
}

/* Twice the slots: zeroed, and filled from the array of states, a batch prefetched at a time. */
static void fill(int32_t *table, u64 slots, const u64 *states, u64 count) {
    u64 mask = slots - 1, at[32];
    memset(table, 0, slots * 4);
    for (u64 first = 0; first < count; first += 32) {
        int width = count - first < 32 ? count - first : 32;
        for (int i = 0; i < width; i++) {
            at[i] = hash(states + (first + i) * WORDS) & mask;
            __builtin_prefetch(table + at[i], 1);
        }
        for (int i = 0; i < width; i++) {
            while (table[at[i]]) at[i] = (at[i] + 1) & mask;
            table[at[i]] = first + i + 1;
        }
    }
}

static void write_file(const char *folder, const char *name, const void *data, size_t size, size_t count) {
    char path[4096];
    snprintf(path, sizeof path, "%s/%s", folder, name);
    FILE *file = fopen(path, "wb");
    if (!file || fwrite(data, size, count, file) != count) exit(4);
#ifdef SYNC
    if (fflush(file) || fsync(fileno(file))) exit(4);
#endif
    if (fclose(file)) exit(4);
}

static double seconds_of(clockid_t clock) {
    struct timespec at;
    clock_gettime(clock, &at);
    return at.tv_sec + 1e-9 * at.tv_nsec;
}

int main(int argc, char **argv) {
    if (argc != 3) return 2;
    u64 last = 1ull << atoi(argv[1]), most = last / 2;
#ifdef FINAL_SIZE
    u64 slots = last;
#else
    u64 slots = 1 << 16;
#endif
    u64 mask = slots - 1;
    double began = seconds_of(CLOCK_MONOTONIC);
    int32_t *table = room(last * 4), *next = room(most * ACTIONS * 4);
    u64 *states = room(most * WORDS * 8);
    State s = start();
    u64 count = 1, ended = 0, depth = 0, last_of_level = 0;
    pack(&s, states);
    table[hash(states) & mask] = 1;
    for (u64 head = 0; head < count;) {
        int width = count - head < BATCH ? count - head : BATCH;
        if (slots < last && count + BATCH * ACTIONS > slots / 2) {
            slots *= 2, mask = slots - 1;
            fill(table, slots, states, count);
        }
        u64 keys[BATCH * ACTIONS][WORDS], slot[BATCH * ACTIONS];
        char over[BATCH];
        for (int i = 0; i < width; i++) {
            unpack(states + (head + i) * WORDS, &s);
            over[i] = terminal(&s);
            for (int x = 0; x < ACTIONS && !over[i]; x++) {
                State t = step(&s, x);
                pack(&t, keys[i * ACTIONS + x]);
                slot[i * ACTIONS + x] = hash(keys[i * ACTIONS + x]) & mask;
                __builtin_prefetch(table + slot[i * ACTIONS + x]);
            }
        }
        for (int i = 0; i < width; i++, head++) {
            if (head > last_of_level) depth++, last_of_level = count - 1;
            ended += over[i];
            for (int x = 0; x < ACTIONS; x++) {
                if (over[i]) {
                    next[head * ACTIONS + x] = head;
                    continue;
                }
                u64 *key = keys[i * ACTIONS + x], at = slot[i * ACTIONS + x];
                while (table[at] && memcmp(states + (u64)(table[at] - 1) * WORDS, key, WORDS * 8)) at = (at + 1) & mask;
                if (!table[at]) {
                    if (count == most) return 3;
                    memcpy(states + count * WORDS, key, WORDS * 8);
                    table[at] = ++count;
                }
                next[head * ACTIONS + x] = table[at] - 1;
            }
        }
    }
    write_file(argv[2], "states.bin", states, WORDS * 8, count);
    write_file(argv[2], "successors.bin", next, ACTIONS * 4, count);
    printf("%lu %lu %lu %.6f %.6f\n", count, ended, depth, seconds_of(CLOCK_MONOTONIC) - began,
           seconds_of(CLOCK_PROCESS_CPUTIME_ID));
    return 0;
}
