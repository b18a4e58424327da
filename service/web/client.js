import{a,b}from"./chunk-2SKLSZE4.js";import"./chunk-I7AUKTXE.js";export{b as Client,a as ServiceError};
