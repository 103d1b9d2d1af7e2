/* A disk that fails at a chosen call, for any process: preloaded (LD_PRELOAD), driven by tests/support/disk_faults.py.

   Every call that changes what lies under the watched folders is a point: open (to write), write, fsync, rename, unlink,
   rmdir, mkdir, truncate and link. A point is named "call path", the path from the last part of its watched folder on,
   with process ids and random names written as *; the n-th call of that name is where the fault strikes. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <signal.h>
#include <stdarg.h>
#include <stdatomic.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <sys/types.h>
#include <sys/uio.h>
#include <unistd.h>

#define NAME (PATH_MAX + 64)
enum kind { NONE, KILL, FULL, ONCE, IO };

static char under[4][PATH_MAX]; /* the watched folders */
static char target[NAME];       /* the point's name */
static int occurrence;          /* which call of that name, from 1 */
static enum kind kind;
static char room[PATH_MAX];     /* once this file is there, the disk is full no longer */
static char frozen[PATH_MAX];   /* as long as this file is there, the disk is read-only */
static int list = -1;           /* what the points are written to, one a line */
static atomic_int seen, is_full;

#define REAL(function) ((__typeof__(&function))dlsym(RTLD_NEXT, #function))

void disk_faults_arm(const char *folders, const char *at, int number, const char *how, const char *list_path,
                     const char *room_path) {
    memset(under, 0, sizeof under);
    for (int i = 0; i < 4 && *folders; i++) {
        size_t length = strcspn(folders, ":");
        if (length < PATH_MAX) memcpy(under[i], folders, length);
        folders += length + (folders[length] == ':');
    }
    snprintf(target, sizeof target, "%s", at);
    snprintf(room, sizeof room, "%s", room_path);
    occurrence = number;
    kind = !strcmp(how, "kill") ? KILL : !strcmp(how, "full") ? FULL : !strcmp(how, "once") ? ONCE
         : !strcmp(how, "io")   ? IO : NONE;
    atomic_store(&seen, 0);
    atomic_store(&is_full, 0);
    if (list >= 0) close(list);
    list = *list_path ? (int)syscall(SYS_openat, AT_FDCWD, list_path, O_WRONLY | O_CREAT | O_APPEND | O_CLOEXEC, 0600) : -1;
}

__attribute__((constructor)) static void from_environment(void) {
    const char *folders = getenv("DISK_FAULTS_UNDER"), *at = getenv("DISK_FAULTS_AT"), *n = getenv("DISK_FAULTS_NUMBER");
    const char *how = getenv("DISK_FAULTS_KIND"), *to = getenv("DISK_FAULTS_LIST"), *until = getenv("DISK_FAULTS_ROOM");
    if (getenv("DISK_FAULTS_READ_ONLY")) snprintf(frozen, sizeof frozen, "%s", getenv("DISK_FAULTS_READ_ONLY"));
    if (folders) disk_faults_arm(folders, at ? at : "", n ? atoi(n) : 0, how ? how : "", to ? to : "", until ? until : "");
}

/* Whether `path` lies under a watched folder; then `name` is "call path". */
static int watched(const char *call, int folder, const char *path, char *name) {
    char whole[2 * PATH_MAX] = "", link[64];
    if (!path) { /* of an open file */
        snprintf(link, sizeof link, "/proc/self/fd/%d", folder);
        ssize_t length = readlink(link, whole, PATH_MAX);
        if (length <= 0) return 0;
        whole[length] = 0;
    } else if (path[0] == '/') {
        snprintf(whole, sizeof whole, "%s", path);
    } else {
        char base[PATH_MAX] = "";
        if (folder == AT_FDCWD) {
            if (!getcwd(base, sizeof base)) return 0;
        } else {
            snprintf(link, sizeof link, "/proc/self/fd/%d", folder);
            ssize_t length = readlink(link, base, sizeof base - 1);
            if (length <= 0) return 0;
            base[length] = 0;
        }
        snprintf(whole, sizeof whole, "%s/%s", base, path);
    }
    for (int i = 0; i < 4 && under[i][0]; i++) {
        size_t length = strlen(under[i]);
        if (strncmp(whole, under[i], length) || (whole[length] && whole[length] != '/')) continue;
        const char *from = strrchr(under[i], '/');
        char *to = name + sprintf(name, "%s ", call);
        for (const char *at = whole + (from - under[i]) + 1; *at;) {
            size_t hex = strspn(at, "0123456789abcdef"), digits = strspn(at, "0123456789");
            if (hex >= 8 || (digits && !strncmp(at + digits, ".tmp", 4))) {
                *to++ = '*';
                at += hex >= 8 ? hex : digits;
            } else {
                *to++ = *at++;
            }
        }
        *to = 0;
        return 1;
    }
    return 0;
}

static int is_there(const char *path) {
    return *path && !syscall(SYS_faccessat, AT_FDCWD, path, F_OK);
}

/* 0 where the call may be made; else the error that it fails with. Where `half`, half of it is to be done before. */
static int fault(const char *call, int folder, const char *path, int needs_space, int *half) {
    char name[2 * NAME + 16];
    if (half) *half = 0;
    if (!under[0][0] || !watched(call, folder, path, name)) return 0;
    if (is_there(frozen)) return EROFS;
    int full = atomic_load(&is_full) && needs_space && !is_there(room);
    int strikes = kind != NONE && !strcmp(name, target) && atomic_fetch_add(&seen, 1) + 1 == occurrence;
    if (list >= 0) {
        char line[2 * NAME + 32];
        int length = snprintf(line, sizeof line, "%s%s\n", strikes ? "! " : "", name);
        syscall(SYS_write, list, line, (size_t)length);
    }
    if (!strikes) return full ? ENOSPC : 0;
    if (half) *half = kind == KILL || kind == FULL;
    if (kind == FULL) atomic_store(&is_full, 1);
    if (kind == KILL && !half) kill(getpid(), SIGKILL);
    return kind == IO ? EIO : ENOSPC;
}

static void die_if_killed(void) {
    if (kind == KILL) kill(getpid(), SIGKILL);
}

#define REFUSE(call, folder, path, needs_space)                        \
    do {                                                               \
        int error = fault(call, folder, path, needs_space, NULL);      \
        if (error) return errno = error, -1;                           \
    } while (0)

static int missing(int folder, const char *path) {
    int before = errno, absent = syscall(SYS_faccessat, folder, path, F_OK) != 0;
    errno = before;
    return absent;
}

#define OPENS(function, folder_parameter, folder, ...)                                      \
    int function(folder_parameter const char *path, int flags, ...) {                       \
        mode_t mode = 0;                                                                    \
        if (flags & (O_CREAT | O_TMPFILE)) {                                                \
            va_list more;                                                                   \
            va_start(more, flags);                                                          \
            mode = va_arg(more, mode_t);                                                    \
            va_end(more);                                                                   \
        }                                                                                   \
        if (flags & (O_CREAT | O_TRUNC | O_WRONLY | O_RDWR))                                \
            REFUSE("open", folder, path, (flags & O_CREAT) && missing(folder, path));       \
        return REAL(function)(__VA_ARGS__ path, flags, mode);                               \
    }
#define COMMA(value) value,
OPENS(open, , AT_FDCWD)
OPENS(open64, , AT_FDCWD)
OPENS(openat, COMMA(int at), at, COMMA(at))
OPENS(openat64, COMMA(int at), at, COMMA(at))

ssize_t write(int file, const void *data, size_t size) {
    int half, error = fault("write", file, NULL, 1, &half);
    if (!error) return REAL(write)(file, data, size);
    if (half && size > 1) { /* a disk that fills up takes the first part; a death leaves as much */
        ssize_t written = REAL(write)(file, data, size / 2);
        die_if_killed();
        return written;
    }
    die_if_killed();
    return errno = error, -1;
}

#define PWRITES(function, offset_t)                                              \
    ssize_t function(int file, const void *data, size_t size, offset_t at) {     \
        int half, error = fault("write", file, NULL, 1, &half);                  \
        if (!error) return REAL(function)(file, data, size, at);                 \
        ssize_t written = half && size > 1 ? REAL(function)(file, data, size / 2, at) : -1; \
        die_if_killed();                                                         \
        return written < 0 ? (errno = error, -1) : written;                      \
    }
PWRITES(pwrite, off_t)
PWRITES(pwrite64, off64_t)

ssize_t writev(int file, const struct iovec *parts, int count) {
    REFUSE("write", file, NULL, 1);
    return REAL(writev)(file, parts, count);
}

int fsync(int file) {
    REFUSE("fsync", file, NULL, 1);
    return REAL(fsync)(file);
}

int fdatasync(int file) {
    REFUSE("fsync", file, NULL, 1);
    return REAL(fdatasync)(file);
}

int ftruncate(int file, off_t size) {
    REFUSE("truncate", file, NULL, 0);
    return REAL(ftruncate)(file, size);
}

int ftruncate64(int file, off64_t size) {
    REFUSE("truncate", file, NULL, 0);
    return REAL(ftruncate64)(file, size);
}

int rename(const char *from, const char *to) {
    REFUSE("rename", AT_FDCWD, to, missing(AT_FDCWD, to));
    return REAL(rename)(from, to);
}

int renameat(int from_folder, const char *from, int to_folder, const char *to) {
    REFUSE("rename", to_folder, to, missing(to_folder, to));
    return REAL(renameat)(from_folder, from, to_folder, to);
}

int unlink(const char *path) {
    REFUSE("unlink", AT_FDCWD, path, 0);
    return REAL(unlink)(path);
}

int unlinkat(int folder, const char *path, int flags) {
    REFUSE(flags & AT_REMOVEDIR ? "rmdir" : "unlink", folder, path, 0);
    return REAL(unlinkat)(folder, path, flags);
}

int rmdir(const char *path) {
    REFUSE("rmdir", AT_FDCWD, path, 0);
    return REAL(rmdir)(path);
}

int mkdir(const char *path, mode_t mode) {
    REFUSE("mkdir", AT_FDCWD, path, 1);
    return REAL(mkdir)(path, mode);
}

int mkdirat(int folder, const char *path, mode_t mode) {
    REFUSE("mkdir", folder, path, 1);
    return REAL(mkdirat)(folder, path, mode);
}

int link(const char *from, const char *to) {
    REFUSE("link", AT_FDCWD, to, 1);
    return REAL(link)(from, to);
}

int symlink(const char *from, const char *to) {
    REFUSE("link", AT_FDCWD, to, 1);
    return REAL(symlink)(from, to);
}
