GOCAD TSurf 1
HEADER {
name: bad one
}
TFACE
VRTX one 0 0 0
END
