import{a,b}from"./chunk-P34NXUW2.js";import"./chunk-I7AUKTXE.js";export{b as Client,a as ServiceError};
